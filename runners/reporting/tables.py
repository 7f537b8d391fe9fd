"""Tables of medians and quartiles, a column for every method."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence

from runners.reporting.evaluation_folder import Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.section import Cell, Table, spread_cells
from runners.reporting.statistics import grouped, spread

DIVERSITY = "diversity"


def method_table(
    title: str,
    heading: str,
    rows: Sequence[Row],
    key: Callable[[Row], Hashable],
    styles: Mapping[str, MethodStyle],
    *,
    column: str = DIVERSITY,
    best: Callable[[Sequence[float]], float] | None = min,
) -> Table:
    """Median [quartiles] of a column by a key (rows, sorted) and method (columns).

    n: of numbers behind a median; a cell that has fewer says so. best: which of a row's medians is
    bold, min, max, or none.
    """
    cells = grouped(rows, lambda row: (key(row), row["method"]))
    lines = []
    for value in sorted({key(row) for row in rows}, key=_order):
        spreads = [spread(cells.get((value, method), ()), column) for method in styles]
        most = Cell(str(max((found.count for found in spreads), default=0)))
        lines.append((Cell(str(value)), most, *spread_cells(spreads, best)))
    header = (heading, "n", *(style.title for style in styles.values()))
    return Table(title, header, tuple(lines))


def _order(value: Hashable) -> tuple[float, str]:
    return (float(value), "") if isinstance(value, int | float) else (0.0, str(value))
