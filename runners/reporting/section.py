"""What a report is made of: sections of a picture, or why there is none, and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from runners.reporting.statistics import Spread


@dataclass(frozen=True)
class Cell:
    """best: the best of its row, shown bold. between: its quartiles. note: such as a count."""

    text: str
    best: bool = False
    between: str = ""
    note: str = ""


@dataclass(frozen=True)
class Table:
    """header: names of the columns, of which the first `labels` are texts. note: what it tells."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    labels: int = 1
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A PNG file. alt: what it shows, for those who do not see it."""

    name: str
    alt: str
    png: bytes


@dataclass(frozen=True)
class Section:
    """name: of its anchor. text: what is shown and how it comes about. missing: why no picture."""

    name: str
    title: str
    text: str
    picture: Picture | None = None
    missing: str = ""
    tables: tuple[Table, ...] = field(default=())


class NotDrawn(Exception):
    """Why there is no picture."""


def number(value: float) -> str:
    """Three digits that count, from a thousand on all before the point; "-" for none."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.2e}"
    if abs(value) >= 1000.0:
        return f"{value:.0f}"
    text = f"{value:.3g}"
    return "1000" if "e" in text else text


def spread_cells(
    spreads: Sequence[Spread], best: Callable[[Sequence[float]], float] | None
) -> list[Cell]:
    """Median [quartiles] of each; notes where numbers are fewer than elsewhere in the row.

    best: which median is bold, where there are several.
    """
    most = max((spread.count for spread in spreads), default=0)
    medians = [spread.median for spread in spreads if spread.count]
    bold = best(medians) if best is not None and len(medians) > 1 else None
    return [_spread_cell(spread, bold, most) for spread in spreads]


def _spread_cell(spread: Spread, bold: float | None, most: int) -> Cell:
    if not spread.count:
        return Cell("-", note=f"{spread.left_out} left out" if spread.left_out else "")
    lower, median, upper = spread.quartiles
    notes = [f"n {spread.count}"] if spread.count < most else []
    notes += [f"{spread.left_out} left out"] if spread.left_out else []
    between = f"[{number(lower)}, {number(upper)}]"
    return Cell(number(median), median == bold, between, ", ".join(notes))
