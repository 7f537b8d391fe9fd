"""Whether sets hold the truth, and how far hypotheses are from it, by the level of faults."""

from __future__ import annotations

from typing import Any

import pandas as pd

from runners.reporting.figures import Picture, legend_of_methods, new_figure
from runners.reporting.section import Section, Styles, Subject
from runners.reporting.statistics import DIVERSITY, shares
from runners.reporting.tables import Cell, Table, method_table
from runners.sessions.faults import CLEAN, LEVELS

_ALL = "all levels"
_HELD, _FAULTS = "truth_held", "faults"
_MEDIANS = {  # column: title and unit of its table, factor
    "nearest_hypothesis": ("From the true pose to the nearest hypothesis, mm", 1e3),
    "position_error": ("Position error of the best hypothesis, mm", 1e3),
    DIVERSITY: ("PD in mm²", 1.0),
}


def by_faults(subject: Subject) -> Section | None:
    """None if no session had faults and no method has a set that holds poses."""
    rows, styles = subject.evaluation.rows, subject.styles
    tables = tables_by_faults(rows, styles)
    if not tables:
        return None
    text = (
        "Sessions with faults have the probes of those without, see docs/faults.md; plausible sets "
        "are of the contacts without faults. All other sections pool the levels. Distances of "
        "hypotheses are root mean square distances between surfaces, so modulo symmetries."
    )
    held = shares_held(rows)
    picture = None if held.empty else picture_of_shares(held, styles)
    title = "Faults, and whether sets hold the truth"
    return Section("faults", title, text, picture, tables=tables)


def tables_by_faults(rows: pd.DataFrame, styles: Styles) -> tuple[Table, ...]:
    """All tables; none if no session had faults and no method has a set that could hold it."""
    by_level, held = rows_by_level(rows), shares_held(rows)
    if held.empty and set(by_level[_FAULTS]) <= {CLEAN}:
        return ()
    tables = [] if held.empty else [held_table(held, styles)]
    for column, (title, factor) in _MEDIANS.items():
        measured = by_level.assign(**{column: factor * by_level[column]})
        some = measured.groupby(_FAULTS, observed=True)[column].transform("count") > 0
        tables.append(method_table(title, measured[some], _FAULTS, styles, column=column))
    return tuple(table for table in tables if table.rows)


def rows_by_level(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with `faults` in the order of LEVELS, and all again if these are several."""
    levels = rows[_FAULTS].fillna(CLEAN)
    order = [level for level in dict.fromkeys([*LEVELS, *levels]) if (levels == level).any()]
    rows = rows.assign(faults=levels)
    if len(order) > 1:
        rows = pd.concat([rows, rows.assign(faults=_ALL)])
    categories = list(dict.fromkeys([*order, _ALL]))
    return rows.assign(faults=pd.Categorical(rows[_FAULTS], categories, ordered=True))


def shares_held(rows: pd.DataFrame) -> pd.DataFrame:
    """`shares` of steps whose set holds the true pose by level and method, of methods that tell."""
    return shares(rows_by_level(rows), [_FAULTS, "method"], _HELD)


def held_table(held: pd.DataFrame, styles: Styles) -> Table:
    """A row for every level."""
    telling = [method for method in styles if method in held.index.unique("method")]
    rows = []
    for level, of_level in held.groupby(level=0, observed=True):
        of_methods = of_level.droplevel(0).reindex(telling)
        rows.append((Cell(str(level)), *map(_share_cell, of_methods.itertuples())))
    note = (
        "Intervals of 95 % (Wilson) as if steps were independent, which those of a session are "
        "not; a set is calibrated where the share is 95 %."
    )
    header = ("faults", *(styles[method].title for method in telling))
    return Table("Steps with the true pose in the set", header, tuple(rows), note=note)


def _share_cell(held: Any) -> Cell:
    if pd.isna(held.share):
        return Cell("-")
    interval = f"[{100.0 * held.lower:.0f}, {100.0 * held.upper:.0f}]"
    return Cell(f"{100.0 * held.share:.0f} %", between=interval, note=f"n {held.total:.0f}")


def picture_of_shares(held: pd.DataFrame, styles: Styles) -> Picture:
    """Shares of steps whose set holds the true pose, with their intervals, by level and method."""
    levels = list(held.index.unique(_FAULTS))
    telling = [method for method in styles if method in held.index.unique("method")]
    figure = new_figure(1.4 + 0.34 * len(levels))
    axes = figure.add_subplot()
    axes.axvline(95.0, color="#222222", linewidth=1.0, linestyle=":")
    texts = []
    for index, method in enumerate(telling):
        style, percent = styles[method], 100.0 * held.xs(method, level="method")
        apart = 0.5 * (index - 0.5 * (len(telling) - 1)) / len(telling)
        share = percent["share"]
        axes.errorbar(
            share,
            [levels.index(level) + apart for level in percent.index],
            xerr=[share - percent["lower"], percent["upper"] - share],
            color=style.color,
            marker=style.marker,
            linestyle="none",
            capsize=3.0,
        )
        texts += [f"{style.title} {value:.0f} % ({level})" for level, value in share.items()]
    axes.set_yticks(range(len(levels)), levels)
    axes.set_ylim(len(levels) - 0.5, -0.5)
    axes.set_xlim(-2.0, 102.0)
    axes.set_xlabel("steps with the true pose in the set, %, with 95 % intervals; dotted: 95 %")
    axes.grid(axis="y", visible=False)
    legend_of_methods(figure, [styles[method] for method in telling])
    alt = f"Share of steps with the true pose in the set, by faults: {', '.join(texts)}."
    return Picture("truth_held", alt, figure, held.reset_index())
