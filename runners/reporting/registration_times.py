"""Time per registration: a bar for every method."""

from __future__ import annotations

from typing import Any

import pandas as pd

from runners.reporting.figures import Picture, new_figure, positive_scale
from runners.reporting.section import Section, Styles, Subject
from runners.reporting.statistics import spreads
from runners.reporting.tables import Cell, Table, number, range_text, table_of


def registration_times(subject: Subject) -> Section | None:
    """A picture of means, and a table; None where no registration has a time."""
    times = times_of(subject.evaluation.rows, subject.styles)
    if times.empty:
        return None
    picture = picture_of_times(times, subject.styles)
    text = (
        "Wall-clock time of the registration alone on one thread, after a warm-up, over all "
        "trials and steps: bars are means, lines one standard deviation to either side, as far as "
        "the axis goes. Several workers on one machine slow each other down."
    )
    table = table_of_times(times, subject.styles)
    return Section("times", "Time per registration", text, picture, tables=(table,))


def times_of(rows: pd.DataFrame, styles: Styles) -> pd.DataFrame:
    """`spreads` and least milliseconds per registration of every method that has some."""
    rows = rows.assign(ms=1e3 * rows["seconds"])
    found = spreads(rows, "method", "ms").join(rows.groupby("method")["ms"].min().rename("least"))
    return found.reindex([method for method in styles if method in found.index]).query("count > 0")


def table_of_times(times: pd.DataFrame, styles: Styles) -> Table:
    """A row for every method."""
    fastest = times["median"].min() if len(times) > 1 else None

    def median(of: Any) -> Cell:
        quartiles = range_text(of.lower, of.upper)
        return Cell(number(of.median), of.median == fastest, quartiles)

    columns = {
        "method": lambda of: styles[of.Index].title,
        "mean": lambda of: of.mean,
        "deviation": lambda of: of.deviation,
        "median [quartiles]": median,
        "registrations": lambda of: of.count,
        "without time": lambda of: of.left_out,
    }
    return table_of("Time per registration in ms", columns, times.itertuples())


def picture_of_times(times: pd.DataFrame, styles: Styles) -> Picture:
    """Mean and standard deviation."""
    figure = new_figure(1.2 + 0.42 * len(times))
    axes = figure.add_subplot()
    floor = max(0.5 * times["least"].min(), 1e-3)
    for place, of in enumerate(times.itertuples()):
        axes.barh(place, of.mean, 0.72, color=styles[of.Index].color)
        axes.errorbar(
            of.mean,
            place,
            xerr=[[min(of.deviation, max(of.mean - floor, 0.0))], [of.deviation]],
            color="#222222",
            elinewidth=1.2,
            capsize=4.0,
        )
        axes.annotate(
            f"{number(of.mean)} ms",
            (max(of.mean + of.deviation, floor), place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=10,
        )
    positive_scale(axes, pd.concat([times["mean"], pd.Series([floor])]), axis="x")
    end = (times["mean"] + times["deviation"]).max()
    axes.set_xlim(floor, end * (end / floor) ** 0.12)  # room for the last number
    axes.set_ylim(len(times) - 0.4, -0.6)
    titles = [styles[method].title for method in times.index]
    axes.set_yticks(range(len(times)), titles)
    axes.set_xlabel("mean time per registration in ms, one standard deviation")
    axes.grid(axis="y", visible=False)
    means = [
        f"{title} {number(mean)} ms" for title, mean in zip(titles, times["mean"], strict=True)
    ]
    alt = f"Bars of the mean time per registration: {', '.join(means)}."
    data = (
        times[["count", "mean", "deviation"]]
        .add_suffix("_ms")
        .rename(columns={"count_ms": "count"})
    )
    return Picture("times", alt, figure, data.reset_index())
