"""Joins the messages of a damaged recording to events, where some of them may be missing."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from chsel.errors import ChselError, RecordingError
from chsel.problem.defaults import object_grid
from chsel.problem.points import GrowingPoints
from chsel.problem.sdf_grid import SdfGrid
from replay.events import (
    Event,
    HypothesesFound,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionStarted,
)
from replay.lost_attachment import LostAttachment
from replay.mcap.attachments import MESH, SDF_GRID, attached
from replay.mcap.contents import Row, rows
from replay.mcap.decision_messages import RecordedDecision
from replay.mcap.encoding import decode
from replay.mcap.event_reader import Entry, EventReader, RecordedProblem
from replay.mcap.plain_config import config_from_json
from replay.mcap.schemas import RECORDS
from replay.mcap.sensor_messages import image_from

WRONG = (ChselError, ValueError, RecursionError)
"""What reading a message may raise."""


class GapReader(EventReader):
    """Joins messages to events where some messages may be missing.

    start: how the session began. remade: attachments that were lost and are there again. wanting:
    whether messages were lost by now. rows: of the contents, once they were there.
    """

    def __init__(self, attachments: dict[str, bytes], size: int) -> None:
        super().__init__(attachments, size)
        self.start: SessionStarted | None = None
        self.rows: list[Row] = []
        self.remade: list[str] = []
        self._points: GrowingPoints | None = None
        self.wanting = False

    def gap(self) -> None:
        """Messages are missing here: what they belonged to is lost."""
        self.wanting = True
        self.within, self._opening = None, {}
        self._clouds.clear()
        self._last_snapshot = None

    def drained(self) -> list[Entry]:
        """The events since the last call; the session's start stays, as the first of all."""
        keep = 0 if self.start is None else 1
        news = self.entries[keep:]
        del self.entries[1:]
        for entry in news:
            if isinstance(entry, SessionStarted):
                self.start, self._points = entry, GrowingPoints(entry.initial_points)
            elif isinstance(entry, Probe) and self._points is not None:
                self._points.add(entry.new_points)
        return news

    def completed(self, entry: Event | RecordedProblem | RecordedDecision) -> Event:
        """With its whole problem; RecordingError if something of lost messages is missing."""
        if not isinstance(entry, RecordedProblem | RecordedDecision):
            return entry
        assert self.start is not None
        assert self._points is not None
        points = self._points.all()
        if isinstance(entry, RecordedProblem):
            return ProblemPosed(entry.step, entry.completed(self.start.sdf, points))
        if self._offered is None:
            raise RecordingError(f"the decision of step {entry.step} has lost its actions")
        return entry.completed(self.start, self._offered, points)

    def _append(self, entry: Entry) -> None:
        self.entries.append(entry)

    def _image(self, values: dict[str, Any]) -> SensorImage:
        self._count_pixels(values)
        return image_from(values)

    def _close(self, values: dict[str, Any]) -> SessionStarted | Probe:
        if self.wanting:  # points that are lost were counted; the new ones must all be there
            self._counts = {name: values[name] - values[f"new_{name}"] for name in self._counts}
        return super()._close(values)

    def _attached(self, name: str, digest: str) -> Any:
        """The mesh or the grid, made again if that is possible, or what stands for a lost one."""
        with suppress(*WRONG):
            return attached(self._attachments, name, digest)
        if name == SDF_GRID:
            with suppress(*WRONG):
                grid = self._grid_again()
                if grid.digest == digest:
                    self.remade.append(name)
                    return grid
        return LostAttachment(name, digest)

    def _grid_again(self) -> SdfGrid:
        """The grid of the mesh, as the session's configuration says; any of WRONG if it cannot."""
        mesh: Any = attached(self._attachments, MESH, self._opening["mesh_digest"])
        session = config_from_json(self._opening["config"]).get("session")
        if not isinstance(session, dict):
            raise RecordingError("the configuration does not say how the grid was made")
        named = (session.get("object_resolution", 0.0), session.get("object_padding"))
        resolution, padding = (float(x) if isinstance(x, int | float) else 0.0 for x in named)
        return object_grid(mesh, None if named[0] is None else resolution, padding=padding)

    def _hypotheses(self, values: dict[str, Any]) -> HypothesesFound:
        try:
            return super()._hypotheses(values)
        except WRONG:
            self._last_elites = values["elites"]  # the next problem, if it refers to them, is
            raise  # believed for its own digest alone

    def _compare_contents(self, data: bytes) -> None:
        self.closed = True
        self.rows = rows(decode(RECORDS["/contents"], data))
