"""Writes a session to an MCAP file: complete, checksummed, the same bytes each time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from chsel.errors import RecordingError
from chsel.events import (
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
from chsel.next_probe.decision_problem import DecisionProblem
from chsel.numerics.arrays import FloatArray, digest
from chsel.problem.points import POINT_CLASSES, KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from replay.files import sync_folder
from replay.mcap.attachments import MEDIA_TYPES, mesh_to_ply, sdf_to_bytes
from replay.mcap.encoding import (
    check_message,
    descriptor_set,
    encode,
    message_class,
    shared_values,
)
from replay.mcap.event_messages import archive_values, event_values
from replay.mcap.foxglove_messages import CLOUDS, FOXGLOVE, log_line, point_cloud
from replay.mcap.schemas import BEFORE_ALL_STEPS, MESH, PROFILE, RECORDS, SDF_GRID, STEP_TIME
from replay.mcap.validation import EventOrder
from replay.mcap.viewer_messages import STARTING_EMPTY, Views, empty_cloud

_CHUNK_SIZE = 8 * 2**20  # bytes: flushing ends a chunk after every probe, well before this
_LIBRARY = "chsel-replay"  # without versions of packages, which stand in the session's environment


class McapRecorder(Recorder):
    """A recorder of one session to a new MCAP file.

    Log time counts messages, in nanoseconds, from one second per step: step k lies between k + 1 s
    and k + 2 s. No wall-clock time enters the file, but for `Timed` events if there are any.
    Raises RecordingError if the file exists, cannot be written, or could not be read back to the
    same values.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._closed = False
        self._order = EventOrder()
        self._views = Views()
        self._points: KnownPoints | None = None  # all that is known, once a session has started
        self._start: SessionStarted | None = None
        self._offered: ActionsOffered | None = None
        self._last_snapshot: SnapshotTaken | None = None
        self._last_elites: FloatArray | None = None
        self._count = 0  # messages written so far
        self._channels: dict[str, int] = {}  # by topic
        with self._writing():
            self._file = self._path.open("xb")
            self._writer = Writer(
                self._file,
                chunk_size=_CHUNK_SIZE,
                compression=CompressionType.ZSTD,
                enable_crcs=True,
                enable_data_crcs=True,
            )
            self._writer.start(profile=PROFILE, library=_LIBRARY)

    def check(self, event: Event) -> None:
        """Raise RecordingError for values that `record` refuses."""
        match event:
            case Logged():
                log_line(event.level, event.text, time=0)
            case HypothesesFound():
                check_message(RECORDS[event.topic], self._hypotheses_values(event))
            case _:
                check_message(RECORDS[event.topic], event_values(event))

    def record(self, event: Event) -> None:
        """Write one event: its messages, then those for viewers."""
        if self._closed:
            raise RecordingError(f"recording {self._path} is closed")
        if not isinstance(event, Event):
            raise RecordingError(f"{type(event).__name__} is not an event of a session")
        if isinstance(event, SessionStarted) is not (self._points is None):
            raise RecordingError(f"recording {self._path} needs one SessionStarted, as first event")
        with self._writing():
            self._order.take(event.topic, event.step)
            self._write(event)
            for topic, make in self._views.after(event):
                self._add(topic, event.step, make=make)
            if isinstance(event, SessionStarted | RigDescribed | ActionsOffered):
                self._writer.flush()  # so that it is read, or lost, apart from what follows

    def flush(self) -> None:
        """End the chunk in progress and hand it to the operating system."""
        if not self._closed:
            with self._writing():
                self._writer.flush()
                self._check_in_place()

    def close(self) -> None:
        """Write index and checksums, and wait until all is on the disk.

        Until then, and after a failure, the file is unfinished.
        """
        if not self._closed:
            with self._writing():
                self._writer.finish()
                self._file.flush()
                self._check_in_place()
                os.fsync(self._file.fileno())
                self._file.close()
                self._closed = True
                sync_folder(self._path.parent)

    def _write(self, event: Event) -> None:
        match event:
            case SessionStarted():
                self._write_session(event)
            case Probe():
                self._record(event.topic, event.step, values=event_values(event))
                assert self._points is not None
                self._write_points(event.step, event.new_points, every=event.added_to(self._points))
            case ProblemPosed():
                self._write_problem(event)
            case ActionsOffered():
                self._record(event.topic, event.step, values=event_values(event))
                self._offered = event
            case Decided():
                self._write_decision(event)
            case SnapshotTaken():
                self._record(event.topic, event.step, values=event_values(event))
                self._last_snapshot = event
            case HypothesesFound():
                self._write_hypotheses(event)
            case Logged():
                self._add(event.topic, event.step, make=partial(log_line, event.level, event.text))
            case _:
                self._record(event.topic, event.step, values=event_values(event))

    def _write_session(self, event: SessionStarted) -> None:
        values = event_values(event)
        check_message("Session", values)
        self._describe_topics()
        for name, data in ((MESH, mesh_to_ply(event.mesh)), (SDF_GRID, sdf_to_bytes(event.sdf))):
            self._writer.add_attachment(0, 0, name, MEDIA_TYPES[name], data)
        self._start = event
        self._record(event.topic, event.step, values=values)
        for topic in STARTING_EMPTY:
            self._add(topic, event.step, make=empty_cloud)
        self._write_points(event.step, event.initial_points, every=event.initial_points)

    def _write_points(self, step: int, new: KnownPoints, *, every: KnownPoints) -> None:
        """Write new points, class by class, and then how many are known with them, `every`."""
        known = np.column_stack([new.known, new.sdf])
        for topic, points in zip(CLOUDS, (new.free, new.occupied, known), strict=True):
            if len(points) > 0:
                self._add(topic, step, make=partial(point_cloud, points))
        self._points = every
        values: dict[str, Any] = {name: len(getattr(self._points, name)) for name in POINT_CLASSES}
        values |= {f"new_{name}": len(getattr(new, name)) for name in POINT_CLASSES}
        values |= {"step": step, "new_digest": new.digest}
        values["normals"] = new.normals if new.has_normals else None
        values["normal_noise"] = new.normal_noise if new.has_normals else None
        self._record("/known_points", step, values=values)

    def _write_problem(self, event: ProblemPosed) -> None:
        problem = event.problem
        if not self._is_given(problem):
            raise RecordingError(
                f"the problem of step {event.step} has points or an SDF grid that the events "
                "before it do not give"
            )
        values = event_values(event)
        elites = self._last_elites
        if elites is not None and digest(problem.low_cost_set) == digest(elites):
            values["low_cost_set"] = None
        self._record(event.topic, event.step, values=values)

    def _write_decision(self, event: Decided) -> None:
        problem = event.problem
        start = self._start
        offered = self._offered
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
        self._record(event.topic, event.step, values=event_values(event))

    def _is_given(self, problem: RegistrationProblem | DecisionProblem) -> bool:
        """Return whether points and grid of a problem are those of the events before."""
        assert self._points is not None
        assert self._start is not None
        given = self._points.digest, self._start.sdf.digest
        return given == (problem.points.digest, problem.sdf.digest)

    def _write_hypotheses(self, event: HypothesesFound) -> None:
        found, last = event.hypotheses, self._last_snapshot
        values = self._hypotheses_values(event)
        archive, repeats = values["archive"], False
        if found.archive is not None:
            repeats = last is not None and _same(last, SnapshotTaken(event.step, found.archive))
        values |= {"archive": None if repeats else archive, "archive_is_last_snapshot": repeats}
        self._record(event.topic, event.step, values=values, archive=archive)
        self._last_elites = found.elites

    def _hypotheses_values(self, event: HypothesesFound) -> dict[str, Any]:
        """Return the message `Hypotheses` with its archive."""
        found = event.hypotheses
        archive = None if found.archive is None else archive_values(event.step, found.archive)
        values = shared_values("Hypotheses", found)
        values |= {"step": event.step, "archive": archive, "archive_is_last_snapshot": False}
        return values

    def _record(self, topic: str, step: int, *, values: dict[str, Any], **repeated: Any) -> None:
        """Write a message of the project's own.

        repeated: values that it leaves out, as they stand in a message before it.
        """
        check_message(RECORDS[topic], values | repeated)
        data = encode(RECORDS[topic], values)
        self._add(topic, step, make=lambda time: data)

    def _add(self, topic: str, step: int, *, make: Callable[[int], bytes]) -> None:
        """Write a message of a step; make: its bytes, from its log time."""
        time = (step - BEFORE_ALL_STEPS) * STEP_TIME + self._count
        self._writer.add_message(
            self._channels[topic], time, make(time), time, sequence=self._count
        )
        self._count += 1

    def _describe_topics(self) -> None:
        """Describe all topics, used or not, and the attachments."""
        topics: dict[str, Any] = {topic: message_class(name) for topic, name in RECORDS.items()}
        schemas: dict[str, int] = {}

        def schema(kind: Any) -> int:
            name = kind.DESCRIPTOR.full_name
            if name not in schemas:
                described = descriptor_set(kind)
                schemas[name] = self._writer.register_schema(name, "protobuf", described)
            return schemas[name]

        for topic, kind in {**topics, **FOXGLOVE}.items():
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema(kind))
        schema(message_class("SdfGrid"))

    def _check_in_place(self) -> None:
        """Raise RecordingError if nobody will find what is written: the file has no name left."""
        if os.fstat(self._file.fileno()).st_nlink == 0:
            self._abandon()
            raise RecordingError(f"recording {self._path} was removed while it was written")

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn errors of the disk into one RecordingError; leave the file alone after any break."""
        try:
            yield
        except OSError as error:
            self._abandon()
            reason = error.strerror or str(error)
            raise RecordingError(f"recording {self._path} cannot be written: {reason}") from error
        except KeyboardInterrupt:
            self._abandon()  # it may have come within a record
            raise

    def _abandon(self) -> None:
        """Close the file as it stands: unfinished, whole up to the last flush."""
        self._closed = True
        if hasattr(self, "_file"):
            with suppress(OSError):
                self._file.close()


def _same(one: SnapshotTaken, other: SnapshotTaken) -> bool:
    """Return whether two snapshots are of the same moment, and equal to the bit."""
    first, second = (
        (each.step, each.archive.iteration, each.archive.refinement, each.archive.digest)
        for each in (one, other)
    )
    return first == second
