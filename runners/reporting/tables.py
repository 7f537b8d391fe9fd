"""Tables of a report: texts by row and column, and how the terminal shows them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pandas as pd

from replay.console import Console, plain_table
from runners.reporting.figures import Styles
from runners.reporting.statistics import DIVERSITY, spreads

Best = Literal["min", "max"] | None  # which number of a row is best
_BEST: dict[str, Best] = {
    "rank": None,
    "exact_members": "max",
    "precision": "max",
    "recall": "max",
}  # by column; of others "min"


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
    """Return a row for each line, of cells by heading: texts, counts (int) or numbers (float)."""
    lines = list(lines)
    rows = [
        tuple(number(cell) if isinstance(cell, float) else str(cell) for cell in line.values())
        for line in lines
    ]
    return Table(
        title, tuple(lines[0]) if lines else (), rows=tuple(rows), labels=labels, note=note
    )


def number(value: float) -> str:
    """Return three significant digits, from a thousand on all before the point; "-" for NaN."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.2e}"
    text = f"{value:.3g}"
    return f"{value:.0f}" if abs(value) >= 1000.0 or "e" in text else text


def with_range(value: float, lower: float, *, upper: float) -> str:
    """Return a number and a range, such as quartiles: "26.1 [17.5, 37.5]"; alone if that is NaN."""
    known = f" [{number(lower)}, {number(upper)}]" if math.isfinite(lower) else ""
    return number(value) + known


def percent(share: float) -> str:
    """Return a share, "12.5 %"."""
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"


def percent_range(found: Any) -> str:
    """Return a share with its interval, of a row of `shares`."""
    share, lower, upper = (100.0 * found[name] for name in ("share", "lower", "upper"))
    return f"{share:.0f} % [{lower:.0f}, {upper:.0f}]"


def bold_best(values: Sequence[float], texts: Sequence[str], *, best: Best = "min") -> list[str]:
    """Return the texts of some values, the best in bold, if there are several values."""
    known = [value for value in values if math.isfinite(value)]
    bold = {"min": min, "max": max}[best](known) if best and len(known) > 1 else None
    return [
        f"**{text}**" if value == bold else text for value, text in zip(values, texts, strict=True)
    ]


def median_cells(found: pd.DataFrame, best: Best) -> list[str]:
    """Return median [quartiles] of each of the `spreads`; a note where numbers are fewer."""
    most = found["count"].max()
    cells = []
    for _, each in found.iterrows():
        notes = [f"n {each['count']:.0f}"] if 0 < each["count"] < most else []
        notes += [f"{each['left_out']:.0f} left out"] if each["left_out"] > 0 else []
        note = f" ({', '.join(notes)})" if notes else ""
        cells.append(with_range(each["median"], each["lower"], upper=each["upper"]) + note)
    return bold_best(found["median"].tolist(), cells, best=best)


def method_table(
    title: str,
    rows: pd.DataFrame,
    *,
    by: str,
    styles: Styles,
    column: str = DIVERSITY,
    note: str = "",
) -> Table:
    """Return median [quartiles] of a column by the values of another (rows) and by method.

    n: of numbers behind a median; a cell that has fewer says so.
    """
    cells, counts = {}, {}
    for value, found in spreads(rows, [by, "method"], column=column).groupby(
        level=0, observed=True
    ):
        of_methods = found.droplevel(0).reindex(list(styles))
        of_methods["count"] = of_methods["count"].fillna(0)
        cells[value] = median_cells(of_methods, _BEST.get(column, "min"))
        counts[value] = int(of_methods["count"].max())
    frame = pd.DataFrame.from_dict(cells, "index", columns=list(styles)).rename_axis(by)
    return pivot_table(title, frame, styles=styles, counts=counts, note=note)


def pivot_table(
    title: str, cells: pd.DataFrame, *, styles: Styles, counts: Any = None, note: str = ""
) -> Table:
    """Return texts by the index (rows) and by method or policy (columns). counts: n by row."""
    lines = []
    for value, texts in cells.reindex(columns=list(styles)).fillna("-").iterrows():
        line = {str(cells.index.name): str(value), **({"n": counts[value]} if counts else {})}
        lines.append(line | {style.title: texts[name] for name, style in styles.items()})
    return table_of(title, lines, note=note)


def print_table(console: Console, table: Table) -> None:
    """Print a table with its title and its note; as wide as it is where there is no terminal."""
    texts, numbers = table.header[: table.labels], table.header[table.labels :]
    shown = plain_table(texts=texts, numbers=numbers)
    for column in shown.columns:
        column.vertical = "bottom"
    for row in table.rows:
        shown.add_row(*(cell.replace("**", "") for cell in row))
    console.print(table.title, soft_wrap=True)
    wide = console if console.is_terminal else Console(file=console.file, width=10_000)
    wide.print(shown)
    if table.note:
        console.print(table.note, soft_wrap=not console.is_terminal)
