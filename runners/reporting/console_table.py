"""Tables of a report on the terminal."""

from __future__ import annotations

from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.measure import Measurement
from rich.table import Table as RichTable

from replay.console import Console
from runners.reporting.section import Cell, Table


def print_table(console: Console, table: Table) -> None:
    """A table with its title and its note; as wide as it is where there is no terminal."""
    shown = RichTable(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for index, name in enumerate(table.header):
        text = index < table.labels
        justify: Literal["left", "right"] = "left" if text else "right"
        shown.add_column(name, justify=justify, no_wrap=text, vertical="bottom")
    for row in table.rows:
        shown.add_row(*(_text(cell) for cell in row))
    console.print(table.title, soft_wrap=True)
    if not console.is_terminal:
        width = Measurement.get(console, console.options.update(width=10_000), shown).maximum
        Console(file=console.file, width=width).print(shown)
    else:
        console.print(shown)
    if table.note:
        console.print(table.note, soft_wrap=True)


def _text(cell: Cell) -> str:
    parts = [cell.text, cell.between, f"({cell.note})" if cell.note else ""]
    return " ".join(part for part in parts if part)
