"""A panel of plausible diversity for every object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from runners.reporting.evaluation_folder import Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.panels import panels
from runners.reporting.section import NotDrawn
from runners.reporting.statistics import grouped
from runners.reporting.tables import DIVERSITY

COLUMNS = 3
Styles = Mapping[str, MethodStyle]


def rows_by_object(rows: Sequence[Row], styles: Styles) -> dict[str, list[Row]]:
    """The rows of these methods that have a PD, by object; NotDrawn if there are none."""
    with_diversity = (row for row in rows if row["method"] in styles and row[DIVERSITY] is not None)
    by_object = grouped(with_diversity, lambda row: row["object"])
    if not by_object:
        raise NotDrawn("no step of these methods has a PD")
    return {name: list(by_object[name]) for name in sorted(by_object)}


def object_panels(
    by_object: Mapping[str, Sequence[Row]],
    styles: Styles,
    draw: Callable[[Axes, Sequence[Row], Styles], None],
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for every object, drawn from its rows."""
    figure, axes = panels(len(by_object), columns=min(COLUMNS, len(by_object)))
    for panel, (name, rows) in zip(axes, by_object.items(), strict=True):
        draw(panel, rows, styles)
        panel.set_title(name.replace("_", " "))
        if panel.get_subplotspec().is_first_col():  # type: ignore[union-attr]
            panel.set_ylabel("PD in mm²")
    return figure, axes
