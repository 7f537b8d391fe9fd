"""Tables of a report: texts by row and column, and how the terminal shows them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.measure import Measurement
from rich.table import Table as RichTable

from replay.console import Console
from runners.reporting.figures import Style
from runners.reporting.statistics import DIVERSITY, spreads

Best = Literal["min", "max"] | None
"""Which median of a row is best."""


@dataclass(frozen=True)
class Table:
    """A table with its title. Cells may have Markdown's **bold**."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int = 1  # so many columns at the left are texts
    note: str = ""  # what the table shows


def table_of(
    title: str, lines: Iterable[Mapping[str, Any]], *, labels: int = 1, note: str = ""
) -> Table:
    """A row for each line, of cells by heading: texts, counts (int) or numbers (float)."""
    lines = list(lines)
    rows = [
        tuple(number(cell) if isinstance(cell, float) else str(cell) for cell in line.values())
        for line in lines
    ]
    return Table(title, tuple(lines[0]) if lines else (), tuple(rows), labels, note)


def number(value: float) -> str:
    """Three significant digits, from a thousand on all before the point; "-" for NaN."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.2e}"
    text = f"{value:.3g}"
    return f"{value:.0f}" if abs(value) >= 1000.0 or "e" in text else text


def with_range(value: float, lower: float, upper: float) -> str:
    """A number and a range, such as quartiles: "26.1 [17.5, 37.5]"."""
    return f"{number(value)} [{number(lower)}, {number(upper)}]" if math.isfinite(lower) else "-"


def percent(share: float) -> str:
    """A share, "12.5 %"."""
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"


def percent_range(found: Any) -> str:
    """A share with its interval, of a row of `shares`."""
    share, lower, upper = (100.0 * found[name] for name in ("share", "lower", "upper"))
    return f"{share:.0f} % [{lower:.0f}, {upper:.0f}]"


def bold_best(values: Sequence[float], texts: Sequence[str], best: Best = "min") -> list[str]:
    """The texts of some values, the best in bold, if there are several values."""
    known = [value for value in values if math.isfinite(value)]
    bold = {"min": min, "max": max}[best](known) if best and len(known) > 1 else None
    return [
        f"**{text}**" if value == bold else text for value, text in zip(values, texts, strict=True)
    ]


def median_cells(found: pd.DataFrame, best: Best) -> list[str]:
    """Median [quartiles] of each of the `spreads`; notes where numbers are fewer than elsewhere."""
    most, cells = found["count"].max(), []
    for each in found.rename(columns={"count": "numbers"}).itertuples():
        notes = [f"n {each.numbers}"] if 0 < each.numbers < most else []
        notes += [f"{each.left_out} left out"] if each.left_out else []
        note = f" ({', '.join(notes)})" if notes else ""
        cells.append(with_range(each.median, each.lower, each.upper) + note)
    return bold_best(found["median"].tolist(), cells, best)


def method_table(
    title: str,
    rows: pd.DataFrame,
    by: str,
    styles: Mapping[str, Style],
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
    for value, found in spreads(rows, [by, "method"], column).groupby(level=0, observed=True):
        of_methods = found.droplevel(0).reindex(list(styles))
        of_methods = of_methods.fillna({"count": 0, "left_out": 0})
        of_methods = of_methods.astype({"count": int, "left_out": int})
        cells = median_cells(of_methods, best)
        titles = [style.title for style in styles.values()]
        line = {by: str(value), "n": int(of_methods["count"].max())}
        lines.append(line | dict(zip(titles, cells, strict=True)))
    return table_of(title, lines, note=note)


def print_table(console: Console, table: Table) -> None:
    """A table with its title and its note; as wide as it is where there is no terminal."""
    shown = RichTable(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for index, name in enumerate(table.header):
        text = index < table.labels
        justify: Literal["left", "right"] = "left" if text else "right"
        shown.add_column(name, justify=justify, no_wrap=text, vertical="bottom")
    for row in table.rows:
        shown.add_row(*(cell.replace("**", "") for cell in row))
    console.print(table.title, soft_wrap=True)
    if not console.is_terminal:
        width = Measurement.get(console, console.options.update(width=10_000), shown).maximum
        Console(file=console.file, width=width).print(shown)
    else:
        console.print(shown)
    if table.note:
        console.print(table.note, soft_wrap=not console.is_terminal)
