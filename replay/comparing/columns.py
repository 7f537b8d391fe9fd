"""The numbers of a comparison: how each is called, in which unit it is kept and shown."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One number. name: in `Outcome.numbers`. unit: in which it is kept, "" for a pure number.

    heading: of a narrow column, lines by "\\n". title: of a plot, with the unit shown. times: what
    turns the number into the unit shown. form: how it is written, as in a format string.
    log: whether it spans orders of magnitude. in_table: whether tables and plots have it.
    """

    name: str
    unit: str
    heading: str
    title: str
    times: float = 1.0
    form: str = ".4g"
    log: bool = False
    in_table: bool = True

    @property
    def csv_name(self) -> str:
        """The name with its unit."""
        return f"{self.name}_{self.unit}" if self.unit else self.name

    def shown(self, value: float | None) -> str:
        """The number in the unit shown, "-" for none; from a hundred on without decimals."""
        if value is None:
            return "-"
        text = f"{self.times * value:{self.form}}"
        return text if self.form != ".1f" or len(text) < 5 else f"{self.times * value:.0f}"


_DEGREES = math.degrees(1.0)

COLUMNS = (
    Column("best_cost", "", "best\ncost", "best cost", form=".3g", log=True),
    Column("median_cost", "", "median\ncost", "median cost", form=".3g", log=True),
    Column("hypotheses", "", "hypo-\ntheses", "hypotheses", in_table=False),
    Column("distinct", "", "dis-\ntinct", "distinct hypotheses"),
    Column("best_position_error", "m", "best\nmm", "position error of the best, mm", 1e3, ".1f"),
    Column(
        "best_rotation_error", "rad", "best\n°", "rotation error of the best, °", _DEGREES, ".1f"
    ),
    Column(
        "closest_position_error", "m", "near\nmm", "position error of the closest, mm", 1e3, ".1f"
    ),
    Column(
        "closest_rotation_error",
        "rad",
        "near\n°",
        "rotation error of the closest, °",
        _DEGREES,
        ".1f",
    ),
    Column("coverage", "mm2", "coverage\nmm²", "coverage, mm²", form=".3g", log=True),
    Column("plausibility", "mm2", "plausibility\nmm²", "plausibility, mm²", form=".3g", log=True),
    Column("diversity", "mm2", "PD\nmm²", "plausible diversity, mm²", form=".3g", log=True),
    Column("seconds", "s", "ms", "time, ms", 1e3, ".1f"),
)
"""All numbers, in the order in which they are shown."""


PLAUSIBLE = ("coverage", "plausibility", "diversity")
"""Numbers about the distance to plausible sets, which have tables of their own."""


def columns_in_table(names: Collection[str]) -> tuple[Column, ...]:
    """The columns of a table or plot, of those numbers that are there."""
    return tuple(column for column in COLUMNS if column.in_table and column.name in names)
