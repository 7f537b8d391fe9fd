"""Medians and quartiles over trials; what has no number is counted apart, never as a zero."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from runners.reporting.evaluation_folder import Row, Trial

_NORMAL_95 = 1.959963984540054  # 97.5th percentile of the normal distribution
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Spread:
    """Numbers in short. left_out: how many more there could be, were they not missing."""

    values: tuple[float, ...]
    left_out: int

    @property
    def count(self) -> int:
        """Of the numbers that there are."""
        return len(self.values)

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """25th, 50th and 75th percentile, interpolated between neighbours; NaN of nothing."""
        if not self.values:
            return math.nan, math.nan, math.nan
        lower, median, upper = np.percentile(self.values, (25.0, 50.0, 75.0)).tolist()
        return lower, median, upper

    @property
    def median(self) -> float:
        """The 50th percentile."""
        return self.quartiles[1]

    @property
    def mean(self) -> float:
        """Of the numbers; NaN of nothing."""
        return float(np.mean(self.values)) if self.values else math.nan

    @property
    def deviation(self) -> float:
        """Standard deviation of the numbers, over n; NaN of nothing."""
        return float(np.std(self.values)) if self.values else math.nan


def spread(rows: Iterable[Row], name: str) -> Spread:
    """The numbers of a column."""
    values = [row.get(name) for row in rows]
    kept = [float(value) for value in values if value is not None]
    return Spread(tuple(kept), len(values) - len(kept))


def share_interval(count: int, total: int) -> tuple[float, float]:
    """The 95 % interval of a share of independent cases, total > 0 (Wilson's score interval)."""
    share, z2 = count / total, _NORMAL_95**2
    centre = (share + z2 / (2.0 * total)) / (1.0 + z2 / total)
    spread_of = math.sqrt(share * (1.0 - share) / total + z2 / (4.0 * total**2))
    half = _NORMAL_95 * spread_of / (1.0 + z2 / total)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def grouped(rows: Iterable[Row], key: Callable[[Row], Key]) -> dict[Key, list[Row]]:
    """Rows by a key, in the order in which keys come first."""
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def trial_of(row: Row) -> Trial:
    """Configuration and seed."""
    return row["configuration"], row["seed"]


def last_half(rows: Sequence[Row]) -> list[Row]:
    """The rows of the latter half of every trial's steps, the middle one of an odd number too.

    The steps of a trial are those of all methods, so that the half is the same for each.
    """
    steps: dict[Any, set[int]] = {}
    for row in rows:
        if row["step"] is not None:
            steps.setdefault(trial_of(row), set()).add(row["step"])
    first = {trial: sorted(found)[len(found) // 2] for trial, found in steps.items()}
    return [row for row in rows if row["step"] is not None and row["step"] >= first[trial_of(row)]]
