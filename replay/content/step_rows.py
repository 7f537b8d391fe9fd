"""What a recording holds, a row for each probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.problem.points import KnownPoints
from replay.events import Event, HypothesesFound, Probe, ProblemPosed, SessionStarted


@dataclass
class StepRow:
    """A probe: all points known with it, and what the registration after it gave."""

    step: int
    free: int
    occupied: int
    known: int
    contacts: int
    posed: bool = False  # whether there is a registration problem
    hypotheses: int = -1  # -1 where there is no result
    distinct: int = -1
    best_cost: float = float("nan")  # NaN where there is no result


class StepRows:
    """The rows of a session, from its events in their order."""

    def __init__(self) -> None:
        self.rows: list[StepRow] = []
        self._counts = np.zeros(4, dtype=np.int64)  # free, occupied, known, contacts

    def take(self, event: Event) -> None:
        """Take note of an event."""
        row = self.rows[-1] if self.rows and self.rows[-1].step == event.step else None
        match event:
            case SessionStarted():
                self._add(event.initial_points)
            case Probe():
                self._add(event.new_points)
                free, occupied, known, contacts = self._counts.tolist()
                self.rows.append(StepRow(event.step, free, occupied, known, contacts))
            case ProblemPosed() if row is not None:
                row.posed = True
            case HypothesesFound() if row is not None:
                found = event.hypotheses
                row.hypotheses, row.distinct = len(found.cost), found.distinct
                row.best_cost = float(found.cost[0]) if len(found.cost) else float("nan")

    def _add(self, new: KnownPoints) -> None:
        self._counts += [len(new.free), len(new.occupied), len(new.known), len(new.contacts)]
