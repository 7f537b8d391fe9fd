"""Time per registration: a bar for every method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from runners.reporting.evaluation_folder import Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.panels import drawn, new_figure, positive_scale
from runners.reporting.section import Cell, NotDrawn, Picture, Table, number
from runners.reporting.statistics import Spread, grouped, spread

_MS = 1e3
Styles = Mapping[str, MethodStyle]


def times_of(rows: Sequence[Row], styles: Styles) -> dict[str, Spread]:
    """Seconds per registration of every method that has some."""
    by_method = grouped(rows, lambda row: row["method"])
    times = {method: spread(by_method.get(method, ()), "seconds") for method in styles}
    return {method: found for method, found in times.items() if found.count}


def picture_of_times(rows: Sequence[Row], styles: Styles, name: str) -> Picture:
    """Mean and standard deviation; NotDrawn where no registration was timed."""
    times = times_of(rows, styles)
    if not times:
        raise NotDrawn("no registration has a time")
    means = ", ".join(f"{styles[method].title} {_ms(found)} ms" for method, found in times.items())
    alt = f"Bars of the mean time per registration: {means}."
    return Picture(name, alt, drawn(lambda: _figure(times, styles)))


def table_of_times(rows: Sequence[Row], styles: Styles) -> Table:
    """Mean, standard deviation, median and quartiles in ms, a row for every method."""
    times = times_of(rows, styles)
    fastest = min((found.median for found in times.values()), default=math.nan)
    lines = []
    for method, found in times.items():
        lower, median, upper = (_MS * value for value in found.quartiles)
        best = len(times) > 1 and found.median == fastest
        lines.append(
            (
                Cell(styles[method].title),
                Cell(_ms(found)),
                Cell(number(_MS * found.deviation)),
                Cell(number(median), best, f"[{number(lower)}, {number(upper)}]"),
                Cell(str(found.count)),
                Cell(str(found.left_out)),
            )
        )
    header = ("method", "mean", "deviation", "median [quartiles]", "registrations", "without time")
    return Table("Time per registration in ms", header, tuple(lines))


def _figure(times: Mapping[str, Spread], styles: Styles) -> Figure:
    figure = new_figure(1.2 + 0.42 * len(times))
    axes = figure.add_subplot()
    means = [_MS * found.mean for found in times.values()]
    ends = [_MS * (found.mean + found.deviation) for found in times.values()]
    least = min(min(_MS * value for value in found.values) for found in times.values())
    floor = max(0.5 * least, 1e-3)
    for place, (method, found) in enumerate(times.items()):
        mean, deviation = _MS * found.mean, _MS * found.deviation
        axes.barh(place, mean, 0.72, color=styles[method].color)
        axes.errorbar(
            mean,
            place,
            xerr=[[min(deviation, max(mean - floor, 0.0))], [deviation]],
            color="#222222",
            elinewidth=1.2,
            capsize=4.0,
        )
        axes.annotate(
            f"{number(mean)} ms",
            (max(mean + deviation, floor), place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=10,
        )
    positive_scale(axes, [floor, *means], axis="x")
    axes.set_xlim(floor, max(ends) * (max(ends) / floor) ** 0.12)  # room for the last number
    axes.set_ylim(len(times) - 0.4, -0.6)
    axes.set_yticks(range(len(times)), [styles[method].title for method in times])
    axes.set_xlabel("mean time per registration in ms, one standard deviation")
    axes.grid(axis="y", visible=False)
    return figure


def _ms(found: Spread) -> str:
    return number(_MS * found.mean)
