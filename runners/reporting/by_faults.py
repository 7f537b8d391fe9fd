"""Tables of how well sets hold the truth, by the level of faults in the sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from runners.reporting.evaluation_folder import Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.section import Cell, Table, spread_cells
from runners.reporting.statistics import Spread, grouped, share_interval, spread
from runners.sessions.faults import CLEAN, LEVELS

_ALL = "all levels"
_HELD = "truth_held"
_LENGTHS = {  # columns in metres
    "nearest_hypothesis": "From the true pose to the nearest hypothesis, mm",
    "position_error": "Position error of the best hypothesis, mm",
}
Styles = Mapping[str, MethodStyle]
Levels = Mapping[str, Sequence[Row]]


def tables_by_faults(rows: Sequence[Row], styles: Styles) -> tuple[Table, ...]:
    """All tables; none if no session had faults and no method has a set that could hold it."""
    levels = rows_by_level(rows)
    told = any(shares_held(levels, method) for method in styles)
    if not told and set(levels) <= {CLEAN}:
        return ()
    tables = (
        *((held_table(levels, styles),) if told else ()),
        *(_table(levels, styles, column, title, 1e3) for column, title in _LENGTHS.items()),
        _table(levels, styles, "diversity", "PD in mm²", 1.0),
    )
    return tuple(table for table in tables if table.rows)


def rows_by_level(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by the level of faults, in the order of LEVELS, then those of none of them."""
    found = grouped(rows, lambda row: str(row.get("faults") or CLEAN))
    return {level: found[level] for level in dict.fromkeys([*LEVELS, *found]) if level in found}


def held_table(levels: Levels, styles: Styles) -> Table:
    """Share of steps whose set holds the true pose, with its interval, of methods that tell."""
    shares = {method: shares_held(levels, method) for method in styles}
    telling = {method: found for method, found in shares.items() if found}
    lines = [
        (Cell(level), *(_share_cell(found.get(level)) for found in telling.values()))
        for level in with_all(levels)
    ]
    header = ("faults", *(styles[method].title for method in telling))
    note = (
        "Intervals of 95 % (Wilson) as if steps were independent, which those of a session are "
        "not; a set is calibrated where the share is 95 %."
    )
    return Table("Steps with the true pose in the set", header, tuple(lines), note=note)


def shares_held(levels: Levels, method: str) -> dict[str, tuple[int, int]]:
    """Steps that hold the truth, and steps that tell, by level."""
    counts: dict[str, tuple[int, int]] = {}
    for level, rows in with_all(levels).items():
        told = [row.get(_HELD) for row in rows if row["method"] == method]
        told = [held for held in told if held is not None]
        if told:
            counts[level] = (sum(bool(held) for held in told), len(told))
    return counts


def _share_cell(counts: tuple[int, int] | None) -> Cell:
    if counts is None:
        return Cell("-")
    low, high = share_interval(*counts)
    share = f"{100.0 * counts[0] / counts[1]:.0f} %"
    return Cell(share, between=f"[{100.0 * low:.0f}, {100.0 * high:.0f}]", note=f"n {counts[1]}")


def _table(levels: Levels, styles: Styles, column: str, title: str, scale: float) -> Table:
    """Median [quartiles] of a column by level, a column for every method."""
    lines = []
    for level, rows in with_all(levels).items():
        by_method = grouped(rows, lambda row: row["method"])
        spreads = [_scaled(spread(by_method.get(method, ()), column), scale) for method in styles]
        if any(found.count for found in spreads):
            most = max(found.count for found in spreads)
            lines.append((Cell(level), Cell(str(most)), *spread_cells(spreads, min)))
    header = ("faults", "n", *(style.title for style in styles.values()))
    return Table(title, header, tuple(lines))


def _scaled(found: Spread, scale: float) -> Spread:
    return Spread(tuple(scale * value for value in found.values), found.left_out)


def with_all(levels: Levels) -> dict[str, Sequence[Row]]:
    """The levels, and all of them together if they are several."""
    if len(levels) < 2:
        return dict(levels)
    return {**levels, _ALL: [row for rows in levels.values() for row in rows]}
