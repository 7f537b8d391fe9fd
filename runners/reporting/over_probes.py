"""PD over the probes: a panel for every object, a median and its quartiles for every method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from runners.reporting.evaluation_folder import Evaluation, Row
from runners.reporting.object_panels import COLUMNS, Styles, object_panels, rows_by_object
from runners.reporting.panels import drawn, legend_of_methods, positive_scale
from runners.reporting.section import Picture
from runners.reporting.statistics import grouped, spread
from runners.reporting.tables import DIVERSITY


def picture_over_probes(evaluation: Evaluation, styles: Styles, name: str) -> Picture:
    """The picture of some methods; NotDrawn where no step has a number."""
    by_object = rows_by_object(evaluation.rows, styles)
    alt = (
        f"Plausible diversity over probes for {', '.join(by_object)}: a line of medians "
        f"with its quartile band for each of {', '.join(s.title for s in styles.values())}."
    )
    return Picture(name, alt, drawn(lambda: _figure(by_object, styles)))


def _figure(by_object: Mapping[str, Sequence[Row]], styles: Styles) -> Figure:
    figure, axes = object_panels(by_object, styles, _draw)
    for panel in axes[-COLUMNS:]:
        panel.set_xlabel("step (index of the probe)")
    shown = {row["method"] for rows in by_object.values() for row in rows}
    legend_of_methods(figure, [style for method, style in styles.items() if method in shown])
    return figure


def _draw(axes: Axes, rows: Sequence[Row], styles: Styles) -> None:
    """One object: of every step, the median and quartiles over trials."""
    drawn_values: list[float] = []
    by_method = grouped(rows, lambda row: row["method"])
    steps = sorted({row["step"] for row in rows})
    for place, (method, style) in enumerate(styles.items()):
        by_step = grouped(by_method.get(method, ()), lambda row: row["step"])
        if not by_step:
            continue
        # A gap where a method has no number but others have.
        quartiles = [spread(by_step.get(step, ()), DIVERSITY).quartiles for step in steps]
        lower, median, upper = (list(part) for part in zip(*quartiles, strict=True))
        drawn_values += [value for value in (*lower, *upper) if not math.isnan(value)]
        sparse = len(by_step) == len(steps) > 8
        axes.fill_between(steps, lower, upper, color=style.color, alpha=0.13, linewidth=0)
        axes.plot(
            steps,
            median,
            color=style.color,
            linestyle=style.line,
            marker=style.marker,
            markevery=(place % 3, 3) if sparse else None,
            zorder=3.0 - 0.01 * place,
        )
    positive_scale(axes, drawn_values)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
