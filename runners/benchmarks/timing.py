"""Repeated measurements of one thing, and what is said of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Row:
    """One line of a table.

    measure: what was varied or looked at. case: the value of it. who: which registration.
    samples: in `unit`, in the order in which they were taken. at: the case as a number, to plot.
    """

    measure: str
    case: str
    who: str
    unit: str
    samples: tuple[float, ...]
    at: float | None = None

    @property
    def median(self) -> float:
        """The middle of the samples."""
        return float(np.median(self.samples))

    @property
    def quartiles(self) -> tuple[float, float]:
        """A quarter of the samples is below the first, a quarter above the second."""
        lower, upper = np.quantile(self.samples, [0.25, 0.75])
        return float(lower), float(upper)

    def mapping(self) -> dict[str, Any]:
        """The row as the report's file has it."""
        lower, upper = self.quartiles
        return {
            "measure": self.measure,
            "case": self.case,
            "who": self.who,
            "at": self.at,
            "unit": self.unit,
            "median": self.median,
            "lower_quartile": lower,
            "upper_quartile": upper,
            "samples": list(self.samples),
        }


def in_turn(
    repeats: int, measured: Mapping[str, Callable[[], float]]
) -> dict[str, tuple[float, ...]]:
    """Take every measurement once, then all of them again: A B A B, never two at a time."""
    samples: dict[str, list[float]] = {name: [] for name in measured}
    for _ in range(repeats):
        for name, measure in measured.items():
            samples[name].append(measure())
    return {name: tuple(values) for name, values in samples.items()}
