"""What is in a recording, a row for each probe: kept as its last message."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from chsel.problem.points import KnownPoints
from replay.events import Event, HypothesesFound, Probe, ProblemPosed, SessionStarted


@dataclass
class Row:
    """A probe: all points known with it, and what the registration after it gave.

    posed: whether there is a registration problem. hypotheses: -1 where there is no result.
    best_cost: NaN where there is no result.
    """

    step: int
    free: int
    occupied: int
    known: int
    contacts: int
    posed: bool = False
    hypotheses: int = -1
    distinct: int = -1
    best_cost: float = float("nan")


_TYPES: dict[str, Any] = {"int": np.int64, "bool": np.bool_, "float": np.float64}


class Contents:
    """The rows of a session, from its events in their order."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self._counts = np.zeros(4, dtype=np.int64)  # free, occupied, known, contacts

    def take(self, event: Event) -> None:
        """Take note of an event."""
        match event:
            case SessionStarted():
                self._add(event.initial_points)
            case Probe():
                self._add(event.new_points)
                free, occupied, known, contacts = self._counts.tolist()
                self.rows.append(Row(event.step, free, occupied, known, contacts))
            case ProblemPosed():
                self.pose(event.step)
            case HypothesesFound():
                found, row = event.hypotheses, self._row(event.step)
                if row is not None:
                    row.hypotheses, row.distinct = len(found.cost), found.distinct
                    row.best_cost = float(found.cost[0]) if len(found.cost) else float("nan")

    def pose(self, step: int) -> None:
        """A registration problem of a step is posed."""
        row = self._row(step)
        if row is not None:
            row.posed = True

    def values(self) -> dict[str, Any]:
        """Columns, as the message `Contents` has them."""
        return {
            column.name: np.array(
                [getattr(row, column.name) for row in self.rows], dtype=_TYPES[str(column.type)]
            )
            for column in fields(Row)
        }

    def _row(self, step: int) -> Row | None:
        """The last probe's, if it is of this step."""
        return self.rows[-1] if self.rows and self.rows[-1].step == step else None

    def _add(self, new: KnownPoints) -> None:
        self._counts += [len(new.free), len(new.occupied), len(new.known), len(new.contacts)]


def rows(values: dict[str, Any]) -> list[Row]:
    """The rows of the message `Contents`."""
    columns = [values[column.name].tolist() for column in fields(Row)]
    return [Row(*row) for row in zip(*columns, strict=True)]
