"""Repeated measurements, and how busy the machine is on which they are taken."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np

from chsel.numerics.threads import threads
from chsel.problem.settings import CheckedSettings, positive, settings_mapping
from runners.command.choices import store


@dataclass(frozen=True)
class Steps(CheckedSettings):
    """How much registrations do that are compared with the package, none of which stops early."""

    restarts: Annotated[int, positive] = 10  # of descent
    adam: Annotated[int, positive] = 50  # Adam steps of a restart
    search: Annotated[int, positive] = 100  # CMA-MEGA iterations
    long_search: Annotated[int, positive] = 500  # the same, in the longer row


store("effort", "default", settings_mapping(Steps()))


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    measure: str  # what was varied or looked at
    case: str  # the value of it
    who: str  # which registration
    unit: str
    samples: tuple[float, ...]  # in the order in which they were taken
    at: float | None = None  # of PD over time: milliseconds
    cost: float | None = None  # of the best pose of a registration

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
        quartiles = {"lower_quartile": lower, "upper_quartile": upper}
        return {**asdict(self), "median": self.median, **quartiles}


def in_turn(
    repeats: int, measured: Mapping[str, Callable[[], float]], *, first_counts: bool = False
) -> dict[str, tuple[float, ...]]:
    """Take every measurement once, then all of them again: A B A B, never two at a time.

    first_counts: else each is taken once more, before all others, and that is left out.
    """
    samples: dict[str, list[float]] = {name: [] for name in measured}
    for _ in range(repeats if first_counts else repeats + 1):
        for name, measure in measured.items():
            samples[name].append(measure())
    return {name: tuple(values[-repeats:]) for name, values in samples.items()}


def milliseconds(run: Callable[[], object], count: int = 1) -> float:
    """What a run takes on so many threads."""
    with threads(count):
        begun = time.perf_counter()
        run()
        return 1000.0 * (time.perf_counter() - begun)


def cores() -> dict[str, int | None]:
    """How many the machine has, and how many this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": os.cpu_count(), "cores_usable": usable}


def load() -> float | None:
    """Processes that ran or waited on average over the last minute, where the system says so."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
