"""Writes a session to an MCAP file: complete, checksummed, the same bytes each time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from chsel.errors import RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.mesh import mesh_digest
from chsel.problem.points import GrowingPoints, KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import ArchiveSnapshot
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    Recorder,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from replay.files import sync_folder
from replay.lost_attachment import LostAttachment, is_lost
from replay.mcap.attachments import MEDIA_TYPES, MESH, SDF_GRID, mesh_to_ply, sdf_to_bytes
from replay.mcap.contents import Contents
from replay.mcap.cumulative_points import CumulativePoints
from replay.mcap.encoding import encode
from replay.mcap.event_checks import check_event
from replay.mcap.event_order import BEFORE_ALL_STEPS, EventOrder
from replay.mcap.foxglove_messages import (
    FOXGLOVE,
    POINT_CLASSES,
    log_line,
    object_in_world,
    point_cloud,
    poses_in_world,
)
from replay.mcap.plain_config import config_to_json
from replay.mcap.scene_messages import (
    POINT_COLORS,
    STARTING_EMPTY,
    SceneMessages,
    colored_cloud,
    empty_cloud,
)
from replay.mcap.schemas import (
    FORMAT_VERSION,
    PROFILE,
    RECORDS,
    STEP_TIME,
    descriptor_set,
    message_class,
)
from replay.mcap.seal import CONTENTS, SEAL, Chain
from replay.mcap.sensor_messages import image_values, rig_values
from replay.mcap.simple_mesh import simple_mesh

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
        self._cumulative = {name: CumulativePoints() for name in POINT_CLASSES}
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
        if isinstance(event, SessionStarted) is not (self._points is None):
            raise RecordingError(f"recording {self._path} needs one SessionStarted, as first event")
        with self._writing():
            self._order.take(event)
            check_event(event)
            if not isinstance(event, SessionStarted) and event.step > self._step:
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
        match event:
            case SessionStarted():
                self._write_session(event)
            case RigDescribed():
                self._record("/rig", event.step, rig_values(event))
                self._end_chunk()  # so that it is read, or lost, apart from what follows
            case SensorImage():
                self._record("/sensor_image", event.step, image_values(event))
            case Probe():
                self._write_probe(event)
            case ProblemPosed():
                self._write_problem(event)
            case SnapshotTaken():
                self._last_snapshot = self._record(
                    "/archive", event.step, _snapshot_values(event.step, event.archive)
                )
            case Traced():
                self._write_trace(event)
            case HypothesesFound():
                self._write_hypotheses(event)
            case Measured():
                self._record("/measured", event.step, {"values": _numbers(event.values)})
            case Timed():
                self._record("/timed", event.step, {"seconds": _numbers(event.seconds)})
            case Logged():
                time = self._time(event.step)
                self._add("/log", time, log_line(event.level, event.text, time))
            case SessionEnded():
                self._record("/session_ended", event.step, {"outcome": event.outcome})
            case _:
                raise RecordingError(f"{type(event).__name__} is no event of a session")

    def _write_session(self, event: SessionStarted) -> None:
        if not is_lost(event.mesh):
            self._attach(MESH, mesh_to_ply(event.mesh))
        if not is_lost(event.sdf):
            self._attach(SDF_GRID, sdf_to_bytes(event.sdf))
        self._sdf_digest = event.sdf.digest
        self._scene = None if is_lost(event.mesh) else SceneMessages(simple_mesh(event.mesh))
        named = ("runner", "object", "session", "method", "seed", "free_resolution")
        values = {name: getattr(event, name) for name in (*named, "world_from_object")}
        values["format_version"] = FORMAT_VERSION
        values["config"] = config_to_json(event.config)
        values["workspace"] = event.workspace.bounds
        values["environment"] = [{"name": k, "value": v} for k, v in event.environment.items()]
        mesh: Any = event.mesh
        values["mesh_digest"] = mesh.digest if is_lost(mesh) else mesh_digest(mesh)
        values["sdf_digest"] = event.sdf.digest
        values["source"] = event.source
        lost = [part for part in (event.mesh, event.sdf) if isinstance(part, LostAttachment)]
        values["lost"] = [part.name for part in lost]
        self._record("/session", BEFORE_ALL_STEPS, values)
        for topic in STARTING_EMPTY:
            time = self._time(BEFORE_ALL_STEPS)
            self._add(topic, time, empty_cloud(time))
        self._points = GrowingPoints(KnownPoints())
        self._write_points(BEFORE_ALL_STEPS, event.initial_points)
        if event.world_from_object is not None:
            time = self._time(BEFORE_ALL_STEPS)
            self._add("/object_pose", time, object_in_world(event.world_from_object, time))
            for name in ("object_mesh", "object_surface") if self._scene else ():
                time = self._time(BEFORE_ALL_STEPS)
                self._add(f"/{name}", time, getattr(self._scene, name)(time))
        self._end_chunk()

    def _attach(self, name: str, data: bytes) -> None:
        self._writer.add_attachment(0, 0, name, MEDIA_TYPES[name], data)
        self._chain.attach(Attachment(0, 0, name, MEDIA_TYPES[name], data))

    def _write_probe(self, event: Probe) -> None:
        named = ("outcome", "gripper_path", "contacts", "contact_normals")
        self._record("/probe", event.step, {name: getattr(event, name) for name in named})
        self._write_points(event.step, event.new_points)
        if len(event.gripper_path) > 0:
            time = self._time(event.step)
            self._add("/gripper_path", time, poses_in_world(event.gripper_path, time))

    def _write_points(self, step: int, new: KnownPoints) -> None:
        """New points, class by class, and then what is known with them."""
        assert self._points is not None
        known = np.column_stack([new.known, new.sdf])
        clouds = {"/points/free": new.free, "/points/occupied": new.occupied}
        for topic, points in {**clouds, "/points/known": known}.items():
            if len(points) > 0:
                time = self._time(step)
                self._add(topic, time, point_cloud(points, time))
        self._points.add(new)
        values: dict[str, Any] = {}
        for name in ("free", "occupied", "known"):
            values[f"new_{name}"] = len(getattr(new, name))
            values[name] = getattr(self._points, name)
        values |= {"new_digest": new.digest, "digest": ""}
        self._record("/known_points", step, values)
        self._write_all_points(step, new)

    def _write_all_points(self, step: int, new: KnownPoints) -> None:
        """For viewers: the clouds of all points so far that change with new ones."""
        for name, cumulative in self._cumulative.items():
            points = getattr(new, name)
            for level, cloud in cumulative.add(points).items() if len(points) else ():
                time = self._time(step)
                topic = f"/all_points/{name}/{level}"
                self._add(topic, time, colored_cloud(cloud, POINT_COLORS[name], time))

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
        values = {
            "initial_set": problem.initial_set,
            "low_cost_set": None if repeats else problem.low_cost_set,
            "workspace": problem.workspace.bounds,
            "free_resolution": problem.free_resolution,
            "key_seed": problem.key.seed,
            "key_step": problem.key.step,
            "points_digest": problem.points.digest,
            "sdf_digest": problem.sdf.digest,
            "digest": problem.digest,
        }
        self._record("/problem", event.step, values)

    def _write_trace(self, event: Traced) -> None:
        lowest, median, highest = event.costs
        values = {name: getattr(event, name) for name in ("stage", "iteration", "digest")}
        values |= {"lowest_cost": lowest, "median_cost": median, "highest_cost": highest}
        self._record("/trace", event.step, values)

    def _write_hypotheses(self, event: HypothesesFound) -> None:
        found = event.hypotheses
        archive, repeats = None, False
        if found.archive is not None:
            archive = _snapshot_values(event.step, found.archive)
            repeats = encode("ArchiveSnapshot", archive) == self._last_snapshot
        named = ("object_from_world", "cost", "duplicate", "cell", "elites", "digest")
        values = {name: getattr(found, name) for name in named}
        values["archive"] = None if repeats else archive
        values["archive_is_last_snapshot"] = repeats
        self._record("/hypotheses", event.step, values)
        self._last_elites = found.elites
        if len(found.object_from_world) > 0:
            time, poses = self._time(event.step), inverse(found.object_from_world)
            self._add("/hypothesis_poses", time, poses_in_world(poses, time))
            for name in ("hypothesis_meshes", "hypothesis_surfaces") if self._scene else ():
                time = self._time(event.step)
                self._add(f"/{name}", time, getattr(self._scene, name)(found, time))

    def _record(self, topic: str, step: int, values: dict[str, Any]) -> bytes:
        """Write a message of the project's own; its bytes."""
        values = values if topic == CONTENTS else {"step": step, **values}
        data = encode(RECORDS[topic], values)
        self._add(topic, self._time(step), data)
        return data

    def _time(self, step: int) -> int:
        """Log time of the next message."""
        return (step - BEFORE_ALL_STEPS) * STEP_TIME + self._count

    def _add(self, topic: str, time: int, data: bytes) -> None:
        channel = self._channels[topic]
        self._writer.add_message(channel, time, data, time, sequence=self._count)
        self._chain.write(topic, Message(channel, time, data, time, self._count))
        self._count += 1
        self._step = time // STEP_TIME + BEFORE_ALL_STEPS
        self._unflushed += len(data)
        if self._unflushed > _CHUNK_SIZE and topic != CONTENTS:
            self._end_chunk()

    def _seal(self) -> None:
        """Close the messages since the last seal, if there are any, with one of their own."""
        if self._chain.is_open and self._count > 0:
            time = self._time(self._step)
            values = self._chain.sealed(self._step, self._count, time)
            self._add(SEAL, time, encode(RECORDS[SEAL], values))

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


def _snapshot_values(step: int, archive: ArchiveSnapshot) -> dict[str, Any]:
    named = ("iteration", "refinement", "measure_names", "shape", "lower", "upper")
    arrays = ("cells", "solutions", "objectives", "measures", "digest")
    return {"step": step} | {name: getattr(archive, name) for name in (*named, *arrays)}


def _numbers(values: Mapping[str, float]) -> list[dict[str, Any]]:
    return [{"name": name, "value": value} for name, value in values.items()]


def _same(a: FloatArray, b: FloatArray) -> bool:
    """Equal to the bit, unlike `==`, for which -0 is 0."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()
