"""Tables of a report: their cells, those of medians by method, and how the terminal shows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.measure import Measurement
from rich.table import Table as RichTable

from replay.console import Console
from runners.reporting.method_style import MethodStyle
from runners.reporting.statistics import DIVERSITY, spreads

Best = Literal["min", "max"] | None
"""Which median of a row is best."""
Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    best: bool = False  # the best of its row, shown bold
    between: str = ""  # quartiles, or another range
    note: str = ""  # such as a count


@dataclass(frozen=True)
class Table:
    """A table with its title."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    labels: int = 1  # so many columns at the left are texts
    note: str = ""  # what the table shows


def table_of(
    title: str,
    columns: Mapping[str, Callable[[Subject], Any]],
    subjects: Iterable[Subject],
    *,
    labels: int = 1,
    note: str = "",
) -> Table:
    """A row for every subject. columns: by heading, what the cell of a subject shows.

    That is a Cell, a text, a count (int), or a number (float).
    """
    rows = [tuple(_cell(show(subject)) for show in columns.values()) for subject in subjects]
    return Table(title, tuple(columns), tuple(rows), labels, note)


def _cell(value: Any) -> Cell:
    if isinstance(value, Cell):
        return value
    return Cell(number(value) if isinstance(value, float) else str(value))


def number(value: float) -> str:
    """Three significant digits, from a thousand on all before the point; "-" for NaN."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.2e}"
    if abs(value) >= 1000.0:
        return f"{value:.0f}"
    text = f"{value:.3g}"
    return "1000" if "e" in text else text


def range_text(lower: float, upper: float) -> str:
    """Such as quartiles, "[17.5, 37.5]"; empty for NaN."""
    return f"[{number(lower)}, {number(upper)}]" if math.isfinite(lower) else ""


def median_cells(found: pd.DataFrame, best: Best) -> list[Cell]:
    """Median [quartiles] of each of the `spreads`; notes where numbers are fewer than elsewhere."""
    most, medians = found["count"].max(), found["median"].dropna()
    bold = medians.agg(best) if best is not None and len(medians) > 1 else None
    cells = []
    for each in found.itertuples():
        notes = [f"n {each.count}"] if 0 < each.count < most else []
        notes += [f"{each.left_out} left out"] if each.left_out else []
        quartiles = range_text(each.lower, each.upper)
        cells.append(Cell(number(each.median), each.median == bold, quartiles, ", ".join(notes)))
    return cells


def method_table(
    title: str,
    rows: pd.DataFrame,
    by: str,
    styles: Mapping[str, MethodStyle],
    *,
    column: str = DIVERSITY,
    best: Best = "min",
    note: str = "",
) -> Table:
    """Median [quartiles] of a column by what another one holds (rows) and by method (columns).

    n: of numbers behind a median; a cell that has fewer says so. best: which of a row's medians is
    bold.
    """
    lines = []
    for value, found in spreads(rows, [by, "method"], column).groupby(level=0):
        of_methods = found.droplevel(0).reindex(list(styles))
        of_methods = of_methods.fillna({"count": 0, "left_out": 0})
        of_methods = of_methods.astype({"count": int, "left_out": int})
        count = Cell(str(of_methods["count"].max()))
        lines.append((Cell(str(value)), count, *median_cells(of_methods, best)))
    header = (by, "n", *(style.title for style in styles.values()))
    return Table(title, header, tuple(lines), note=note)


def print_table(console: Console, table: Table) -> None:
    """A table with its title and its note; as wide as it is where there is no terminal."""
    shown = RichTable(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for index, name in enumerate(table.header):
        text = index < table.labels
        justify: Literal["left", "right"] = "left" if text else "right"
        shown.add_column(name, justify=justify, no_wrap=text, vertical="bottom")
    for row in table.rows:
        shown.add_row(*(_plain_text(cell) for cell in row))
    console.print(table.title, soft_wrap=True)
    if not console.is_terminal:
        width = Measurement.get(console, console.options.update(width=10_000), shown).maximum
        Console(file=console.file, width=width).print(shown)
    else:
        console.print(shown)
    if table.note:
        console.print(table.note, soft_wrap=not console.is_terminal)


def _plain_text(cell: Cell) -> str:
    parts = [cell.text, cell.between, f"({cell.note})" if cell.note else ""]
    return " ".join(part for part in parts if part)
