"""Writes a session to an MCAP file: complete, checksummed, the same bytes each time."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import RecordingError
from chsel.next_probe.decision_problem import DecisionProblem
from chsel.numerics.arrays import FloatArray, same_bits
from chsel.problem.points import GrowingPoints, KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from replay.events import (
    ActionsOffered,
    Decided,
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    RigDescribed,
    SessionStarted,
    SnapshotTaken,
)
from replay.lost_attachment import is_lost
from replay.mcap.attachments import MESH, SDF_GRID, mesh_to_ply, sdf_to_bytes
from replay.mcap.contents import Contents
from replay.mcap.encoding import check_message, encode
from replay.mcap.event_messages import (
    archive_values,
    event_values,
    is_steered,
    shared_values,
    version_of,
)
from replay.mcap.foxglove_messages import CLOUDS, POINT_CLASSES, log_line, point_cloud
from replay.mcap.schemas import RECORDS
from replay.mcap.seal import CONTENTS
from replay.mcap.sealed_file import SealedFile
from replay.mcap.validation import EventOrder
from replay.mcap.viewer_messages import STARTING_EMPTY, Views, empty_cloud


class McapRecorder(Recorder):
    """Writes one recording to a new file.

    Log time counts messages, in nanoseconds, from one second per step: step k lies between k + 1 s
    and k + 2 s. No wall-clock time enters the file, but for `Timed` events if there are any.
    Raises RecordingError if the file exists, cannot be written, or could not be read back to the
    same values.
    """

    def __init__(self, path: str | Path) -> None:
        self._file = SealedFile(Path(path))
        self._contents = Contents()
        self._order = EventOrder()
        self._views = Views()
        self._points: GrowingPoints | None = None  # all that is known, once a session has started
        self._start: SessionStarted | None = None
        self._offered: ActionsOffered | None = None
        self._last_snapshot: SnapshotTaken | None = None
        self._last_elites: FloatArray | None = None

    @property
    def digest(self) -> str:
        """The digest of all that is sealed so far: of the recording, once it is closed."""
        return self._file.chain.last

    def record(self, event: Event) -> None:
        """Write one event: its messages, then those for viewers."""
        path = self._file.path
        if self._file.closed:
            raise RecordingError(f"recording {path} is closed")
        if not isinstance(event, Event):
            raise RecordingError(f"{type(event).__name__} is not an event of a session")
        if isinstance(event, SessionStarted) is not (self._points is None):
            raise RecordingError(f"recording {path} needs one SessionStarted, as first event")
        with self._file.writing():
            self._order.take(event.topic, event.step)
            if event.step > self._file.step:
                self._file.seal()
            self._write(event)
            for topic, make in self._views.after(event):
                self._file.add(topic, event.step, make)
            if isinstance(event, SessionStarted | RigDescribed | ActionsOffered):
                self._file.end_chunk()  # so that it is read, or lost, apart from what follows
        self._contents.take(event)

    def flush(self) -> None:
        """End the chunk in progress and hand it to the operating system."""
        if not self._file.closed:
            with self._file.writing():
                self._file.end_chunk()
                self._file.check_in_place()

    def close(self) -> None:
        """Write contents and checksums, and wait until all is on the disk.

        Until then, and after a failure, the file is unfinished.
        """
        if not self._file.closed:
            with self._file.writing():
                if self._points is not None:
                    self._file.seal()
                    chain = self._file.chain
                    ends = {"session": chain.session, "digest": chain.last}
                    self._record(CONTENTS, self._file.step, self._contents.values() | ends)
                self._file.finish()

    def _write(self, event: Event) -> None:
        match event:
            case SessionStarted():
                self._write_session(event)
            case Probe():
                self._record(event.topic, event.step, event_values(event))
                self._write_points(event.step, event.new_points)
            case ProblemPosed():
                self._write_problem(event)
            case ActionsOffered():
                self._write_actions(event)
            case Decided():
                self._write_decision(event)
            case SnapshotTaken():
                self._record(event.topic, event.step, event_values(event))
                self._last_snapshot = event
            case HypothesesFound():
                self._write_hypotheses(event)
            case Logged():
                self._file.add(event.topic, event.step, partial(log_line, event.level, event.text))
            case _:
                self._record(event.topic, event.step, event_values(event))

    def _write_session(self, event: SessionStarted) -> None:
        values = event_values(event)
        check_message("Session", values)
        self._file.describe(version_of(event))
        if not is_lost(event.mesh):
            self._file.attach(MESH, mesh_to_ply(event.mesh))
        if not is_lost(event.sdf):
            self._file.attach(SDF_GRID, sdf_to_bytes(event.sdf))
        self._start = event
        self._record(event.topic, event.step, values)
        for topic in STARTING_EMPTY:
            self._file.add(topic, event.step, empty_cloud)
        self._points = GrowingPoints(KnownPoints())
        self._write_points(event.step, event.initial_points)

    def _write_points(self, step: int, new: KnownPoints) -> None:
        """New points, class by class, and then how many are known with them."""
        assert self._points is not None
        known = np.column_stack([new.known, new.sdf])
        for topic, points in zip(CLOUDS, (new.free, new.occupied, known), strict=True):
            if len(points) > 0:
                self._file.add(topic, step, partial(point_cloud, points))
        self._points.add(new)
        values = {name: getattr(self._points, name) for name in POINT_CLASSES}
        values |= {f"new_{name}": len(getattr(new, name)) for name in POINT_CLASSES}
        values |= {"step": step, "new_digest": new.digest, "digest": ""}
        self._record("/known_points", step, values)

    def _write_problem(self, event: ProblemPosed) -> None:
        problem = event.problem
        if not self._is_given(problem):
            raise RecordingError(
                f"the problem of step {event.step} has points or an SDF grid that the events "
                "before it do not give"
            )
        values = event_values(event)
        if self._last_elites is not None and same_bits(problem.low_cost_set, self._last_elites):
            values["low_cost_set"] = None
        self._record(event.topic, event.step, values)

    def _write_actions(self, event: ActionsOffered) -> None:
        assert self._start is not None
        if not is_steered(self._start):
            raise RecordingError(
                "the session offers actions but has no policy; accepted: a configuration with a "
                "group policy"
            )
        self._record(event.topic, event.step, event_values(event))
        self._offered = event

    def _write_decision(self, event: Decided) -> None:
        problem, start, offered = event.problem, self._start, self._offered
        assert start is not None
        if offered is None or not (
            self._is_given(problem)
            and (problem.workspace, problem.free_resolution)
            == (start.workspace, start.free_resolution)
            and problem.actions.digest == offered.actions.digest
            and problem.hand.digest == offered.hand.digest
        ):
            raise RecordingError(
                f"the problem of the decision of step {event.step} has points, a grid, a "
                "workspace, actions or a hand that the events before it do not give"
            )
        self._record(event.topic, event.step, event_values(event))

    def _is_given(self, problem: RegistrationProblem | DecisionProblem) -> bool:
        """Whether points and grid of a problem are those of the events before."""
        assert self._points is not None
        assert self._start is not None
        same_points = self._points.same(problem.points)
        return same_points and problem.sdf.digest == self._start.sdf.digest

    def _write_hypotheses(self, event: HypothesesFound) -> None:
        found, last = event.hypotheses, self._last_snapshot
        archive, repeats = None, False
        if (final := found.archive) is not None:
            if last is not None and last.step == event.step and final.same(last.archive):
                final, repeats = last.archive, True  # it has its digest
            archive = archive_values(event.step, final)
        values = shared_values("Hypotheses", found) | {
            "step": event.step,
            "archive": None if repeats else archive,
            "archive_is_last_snapshot": repeats,
        }
        self._record(event.topic, event.step, values, archive=archive)
        self._last_elites = found.elites

    def _record(self, topic: str, step: int, values: dict[str, Any], **repeated: Any) -> None:
        """Write a message of the project's own.

        repeated: values that it leaves out, as they stand in a message before it.
        """
        check_message(RECORDS[topic], values | repeated)
        data = encode(RECORDS[topic], values)
        self._file.add(topic, step, lambda time: data)
