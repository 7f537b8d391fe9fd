"""Box plots of PD: a panel for every object, a box for every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.cbook import boxplot_stats
from matplotlib.figure import Figure

from runners.reporting.evaluation_folder import Row
from runners.reporting.object_panels import COLUMNS, Styles, object_panels, rows_by_object
from runners.reporting.panels import drawn, positive_scale
from runners.reporting.section import Picture
from runners.reporting.statistics import grouped, spread
from runners.reporting.tables import DIVERSITY


def picture_of_boxes(rows: Sequence[Row], styles: Styles, name: str) -> Picture:
    """The picture of the numbers of these rows; NotDrawn where there are none."""
    by_object = rows_by_object(rows, styles)
    alt = (
        f"Box plots of plausible diversity for {', '.join(by_object)}, a box for each of "
        f"{', '.join(style.title for style in styles.values())}."
    )
    return Picture(name, alt, drawn(lambda: _figure(by_object, styles)))


def _figure(by_object: Mapping[str, Sequence[Row]], styles: Styles) -> Figure:
    figure, axes = object_panels(by_object, styles, _draw)
    for index, panel in enumerate(axes):
        lowest = index + COLUMNS >= len(axes)
        names = [style.title for style in styles.values()] if lowest else []
        panel.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=10)
    return figure


def _draw(axes: Axes, rows: Sequence[Row], styles: Styles) -> None:
    """Boxes from the 25th to the 75th percentile; whiskers to the last number within 1.5 boxes."""
    by_method = grouped(rows, lambda row: row["method"])
    drawn_values: list[float] = []
    for place, (method, style) in enumerate(styles.items()):
        values = spread(by_method.get(method, ()), DIVERSITY).values
        if not values:
            continue
        drawn_values += values
        found = boxplot_stats(values, whis=1.5)
        flat = found[0]["q1"] == found[0]["q3"]  # all that is seen of such a box is its median
        axes.bxp(
            found,
            positions=[place],
            widths=0.7,
            patch_artist=True,
            boxprops={"facecolor": style.color, "edgecolor": "#222222", "linewidth": 0.8},
            medianprops={"color": style.color if flat else "#ffffff", "linewidth": 2.0},
            whiskerprops={"color": "#222222", "linewidth": 0.9},
            capprops={"color": "#222222", "linewidth": 0.9},
            flierprops={
                "marker": "D",
                "markersize": 3.0,
                "markerfacecolor": style.color,
                "markeredgecolor": "none",
            },
        )
    positive_scale(axes, drawn_values)
    axes.set_xlim(-0.6, len(styles) - 0.4)
    axes.grid(axis="x", visible=False)
