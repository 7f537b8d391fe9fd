"""Writes a session to an MCAP file: complete, checksummed, the same bytes each time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from chsel.errors import RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import GrowingPoints, KnownPoints
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    RigDescribed,
    SensorImage,
    SessionStarted,
    SnapshotTaken,
)
from replay.files import sync_folder
from replay.lost_attachment import is_lost
from replay.mcap.attachments import MEDIA_TYPES, MESH, SDF_GRID, mesh_to_ply, sdf_to_bytes
from replay.mcap.contents import Contents
from replay.mcap.encoding import check_message, descriptor_set, encode, message_class
from replay.mcap.event_messages import (
    archive_values,
    event_values,
    problem_values,
    session_values,
    shared_values,
)
from replay.mcap.foxglove_messages import (
    CLOUDS,
    FOXGLOVE,
    POINT_CLASSES,
    log_line,
    point_cloud,
)
from replay.mcap.schemas import BEFORE_ALL_STEPS, PROFILE, RECORDS, STEP_TIME
from replay.mcap.seal import CONTENTS, SEAL, Chain
from replay.mcap.sensor_messages import image_values, rig_values
from replay.mcap.validation import EventOrder
from replay.mcap.viewer_messages import STARTING_EMPTY, Views, empty_cloud

_CHUNK_SIZE = 8 * 2**20  # bytes: flushing ends a chunk after every probe, well before this
_NEVER = 2**62  # the size at which the library would end a chunk by itself, without a seal
_LIBRARY = "chsel-replay"  # without versions of packages, which stand in the session's environment


class McapRecorder(Recorder):
    """Writes one recording to a new file.

    Log time counts messages, in nanoseconds, from one second per step: step k lies between k + 1 s
    and k + 2 s. No wall-clock time enters the file, but for `Timed` events if there are any.
    Raises RecordingError if the file exists, cannot be written, or could not be read back to the
    same values.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._closed = False
        self._contents = Contents()
        self._order = EventOrder()
        self._chain = Chain()
        self._count = 0  # messages written so far
        self._step = BEFORE_ALL_STEPS  # of the last message
        self._unflushed = 0  # bytes of messages in the chunk in progress
        self._channels: dict[str, int] = {}
        self._points: GrowingPoints | None = None  # all that is known, once a session has started
        self._views = Views()
        self._sdf_digest = ""
        self._last_snapshot = b""
        self._last_elites: FloatArray | None = None
        with self._writing():
            self._file = self._path.open("xb")
            self._begin()

    @property
    def digest(self) -> str:
        """The digest of all that is sealed so far: of the recording, once it is closed."""
        return self._chain.last

    def record(self, event: Event) -> None:
        """Write one event."""
        if self._closed:
            raise RecordingError(f"recording {self._path} is closed")
        if not isinstance(event, Event):
            raise RecordingError(f"{type(event).__name__} is not an event of a session")
        if isinstance(event, SessionStarted) is not (self._points is None):
            raise RecordingError(f"recording {self._path} needs one SessionStarted, as first event")
        with self._writing():
            self._order.take(event.topic, event.step)
            if event.step > self._step:
                self._seal()
            self._write(event)
        self._contents.take(event)

    def flush(self) -> None:
        """End the chunk in progress and hand it to the operating system."""
        if not self._closed:
            with self._writing():
                self._end_chunk()
                self._check_in_place()

    def close(self) -> None:
        """Write contents and checksums, and wait until all is on the disk.

        Until then, and after a failure, the file is unfinished.
        """
        if not self._closed:
            with self._writing():
                if self._points is not None:
                    self._seal()
                    ends = {"session": self._chain.session, "digest": self._chain.last}
                    self._record(CONTENTS, self._step, self._contents.values() | ends)
                self._writer.finish()
                self._file.flush()
                self._check_in_place()
                os.fsync(self._file.fileno())
                self._file.close()
            self._closed = True
            sync_folder(self._path.parent)

    def _begin(self) -> None:
        """Start the file, with a description of every topic, used or not."""
        self._writer = Writer(
            self._file,
            chunk_size=_NEVER,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile=PROFILE, library=_LIBRARY)
        topics: dict[str, Any] = {topic: message_class(name) for topic, name in RECORDS.items()}
        schemas: dict[str, int] = {}
        for topic, kind in {**topics, **FOXGLOVE}.items():
            name = kind.DESCRIPTOR.full_name
            if name not in schemas:
                schemas[name] = self._register_schema(kind)
            number = self._writer.register_channel(topic, "protobuf", schemas[name])
            self._channels[topic] = number
            self._chain.describe(Channel(number, topic, "protobuf", {}, schemas[name]))
        self._register_schema(message_class("SdfGrid"))  # the file describes its attachment too

    def _register_schema(self, kind: Any) -> int:
        name, described = kind.DESCRIPTOR.full_name, descriptor_set(kind)
        number: int = self._writer.register_schema(name, "protobuf", described)
        self._chain.describe(Schema(id=number, data=described, encoding="protobuf", name=name))
        return number

    def _write(self, event: Event) -> None:
        """Write the messages of an event, then those for viewers."""
        step = event.step
        match event:
            case SessionStarted():
                self._write_session(event)
            case Probe():
                self._record(event.topic, step, event_values(event))
                self._write_points(step, event.new_points)
            case ProblemPosed():
                self._write_problem(event)
            case SnapshotTaken():
                values = archive_values(step, event.archive)
                self._last_snapshot = self._record(event.topic, step, values)
            case HypothesesFound():
                self._write_hypotheses(event)
            case SensorImage():
                self._record(event.topic, step, image_values(event))
            case RigDescribed():
                self._record(event.topic, step, rig_values(event))
                self._end_chunk()  # so that it is read, or lost, apart from what follows
            case Logged():
                self._add(event.topic, step, partial(log_line, event.level, event.text))
            case _:
                self._record(event.topic, step, event_values(event))
        for topic, make in self._views.after(event):
            self._add(topic, step, make)
        if isinstance(event, SessionStarted):
            self._end_chunk()

    def _write_session(self, event: SessionStarted) -> None:
        values = session_values(event)
        check_message("Session", values)
        if not is_lost(event.mesh):
            self._attach(MESH, mesh_to_ply(event.mesh))
        if not is_lost(event.sdf):
            self._attach(SDF_GRID, sdf_to_bytes(event.sdf))
        self._sdf_digest = event.sdf.digest
        self._record(event.topic, event.step, values)
        for topic in STARTING_EMPTY:
            self._add(topic, event.step, empty_cloud)
        self._points = GrowingPoints(KnownPoints())
        self._write_points(event.step, event.initial_points)

    def _attach(self, name: str, data: bytes) -> None:
        self._writer.add_attachment(0, 0, name, MEDIA_TYPES[name], data)
        self._chain.attach(Attachment(0, 0, name, MEDIA_TYPES[name], data))

    def _write_points(self, step: int, new: KnownPoints) -> None:
        """New points, class by class, and then how many are known with them."""
        assert self._points is not None
        known = np.column_stack([new.known, new.sdf])
        for topic, points in zip(CLOUDS, (new.free, new.occupied, known), strict=True):
            if len(points) > 0:
                self._add(topic, step, partial(point_cloud, points))
        self._points.add(new)
        values = {name: getattr(self._points, name) for name in POINT_CLASSES}
        values |= {f"new_{name}": len(getattr(new, name)) for name in POINT_CLASSES}
        values |= {"step": step, "new_digest": new.digest, "digest": ""}
        self._record("/known_points", step, values)

    def _write_problem(self, event: ProblemPosed) -> None:
        problem = event.problem
        assert self._points is not None
        known = self._points.all()
        if problem.points.digest != known.digest or problem.sdf.digest != self._sdf_digest:
            raise RecordingError(
                f"the problem of step {event.step} has points or an SDF grid that the events "
                "before it do not give"
            )
        repeats = self._last_elites is not None and _same(problem.low_cost_set, self._last_elites)
        self._record(event.topic, event.step, problem_values(event, repeats_elites=repeats))

    def _write_hypotheses(self, event: HypothesesFound) -> None:
        found = event.hypotheses
        archive, repeats = None, False
        if found.archive is not None:
            archive = archive_values(event.step, found.archive)
            repeats = encode("ArchiveSnapshot", archive) == self._last_snapshot
        values = shared_values("Hypotheses", found) | {
            "step": event.step,
            "archive": None if repeats else archive,
            "archive_is_last_snapshot": repeats,
        }
        self._record(event.topic, event.step, values, archive=archive)
        self._last_elites = found.elites

    def _record(self, topic: str, step: int, values: dict[str, Any], **repeated: Any) -> bytes:
        """Write a message of the project's own; its bytes.

        repeated: values that it leaves out, as they stand in a message before it.
        """
        check_message(RECORDS[topic], values | repeated)
        data = encode(RECORDS[topic], values)
        self._add(topic, step, lambda time: data)
        return data

    def _time(self, step: int) -> int:
        """Log time of the next message."""
        return (step - BEFORE_ALL_STEPS) * STEP_TIME + self._count

    def _add(self, topic: str, step: int, make: Callable[[int], bytes]) -> None:
        """Write a message of a step; make: its bytes, from its log time."""
        channel, time = self._channels[topic], self._time(step)
        data = make(time)
        self._writer.add_message(channel, time, data, time, sequence=self._count)
        self._chain.write(topic, Message(channel, time, data, time, self._count))
        self._count += 1
        self._step = step
        self._unflushed += len(data)
        if self._unflushed > _CHUNK_SIZE and topic != CONTENTS:
            self._end_chunk()

    def _seal(self) -> None:
        """Close the messages since the last seal, if there are any, with one of their own."""
        if self._chain.is_open and self._count > 0:
            values = self._chain.sealed(self._step, self._count, self._time(self._step))
            self._record(SEAL, self._step, values)

    def _end_chunk(self) -> None:
        """End the chunk in progress with a seal, and hand it to the operating system."""
        self._unflushed = 0
        self._seal()
        self._writer.flush()
        self._unflushed = 0

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

    def _check_in_place(self) -> None:
        """Raise RecordingError if nobody will find what is written: the file has no name left."""
        if os.fstat(self._file.fileno()).st_nlink == 0:
            self._abandon()
            raise RecordingError(f"recording {self._path} was removed while it was written")

    def _abandon(self) -> None:
        """Close the file as it stands: unfinished, whole up to the last flush."""
        self._closed = True
        if hasattr(self, "_file"):
            with suppress(OSError):
                self._file.close()


def _same(a: FloatArray, b: FloatArray) -> bool:
    """Equal to the bit, unlike `==`, for which -0 is 0."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()
