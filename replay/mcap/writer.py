"""Writes a session to an MCAP file: complete, checksummed, the same bytes each time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from chsel.arrays import FloatArray
from chsel.errors import RecordingError
from chsel.mesh import mesh_digest
from chsel.points import KnownPoints
from chsel.pose import inverse
from chsel.problem import ArchiveSnapshot
from replay.disk import sync_folder
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
    PROFILE,
    RECORDS,
    SINCE_VERSION,
    STEP_TIME,
    descriptor_set,
    message_class,
)
from replay.mcap.sensor_messages import image_values, rig_values
from replay.mcap.simple_mesh import simple_mesh

_CHUNK_SIZE = 8 * 2**20  # bytes: flushing ends a chunk after every probe, well before this
_FIRST_VERSION = 1
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
        self._before_steps: list[Event] = []  # as long as a rig may follow
        with self._writing():
            self._file = self._path.open("xb")
            self._begin(_FIRST_VERSION)

    def record(self, event: Event) -> None:
        """Write one event."""
        if self._closed:
            raise RecordingError(f"recording {self._path} is closed")
        if isinstance(event, SessionStarted) is not (self._points is None):
            raise RecordingError(f"recording {self._path} needs one SessionStarted, as first event")
        with self._writing():
            self._order.take(event)
            check_event(event)
            if isinstance(event, RigDescribed):
                self._begin_again(max(SINCE_VERSION.values()))
            self._write(event)
        self._contents.take(event)
        if self._order.has_rig or self._order.step != BEFORE_ALL_STEPS:
            self._before_steps.clear()
        else:
            self._before_steps.append(event)

    def flush(self) -> None:
        """End the chunk in progress and hand it to the operating system."""
        if not self._closed:
            with self._writing():
                self._writer.flush()
                self._check_in_place()

    def close(self) -> None:
        """Write contents and checksums, and wait until all is on the disk.

        Until then, and after a failure, the file is unfinished.
        """
        if not self._closed:
            with self._writing():
                if self._points is not None:
                    self._record("/contents", self._order.step, self._contents.values())
                self._writer.finish()
                self._file.flush()
                self._check_in_place()
                os.fsync(self._file.fileno())
                self._file.close()
            self._closed = True
            sync_folder(self._path.parent)

    def _begin(self, version: int) -> None:
        """Start a file, of a version that has all topics that its events will need."""
        self._version = version
        self._count = 0  # messages written so far
        self._channels: dict[str, int] = {}
        self._points: KnownPoints | None = None  # all that is known, once a session has started
        self._cumulative = {name: CumulativePoints() for name in POINT_CLASSES}
        self._sdf_digest = ""
        self._last_snapshot = b""
        self._last_elites: FloatArray | None = None
        self._writer = Writer(
            self._file,
            chunk_size=_CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile=PROFILE, library=_LIBRARY)
        self._register_channels()

    def _begin_again(self, version: int) -> None:
        """Write all events so far once more, in a file of a higher version.

        Only what comes after a session's start tells whether that is needed. A reader of a lower
        version would pass unknown topics by and take the rest for the whole.
        """
        self._file.seek(0)
        self._file.truncate()
        self._begin(version)
        for event in self._before_steps:
            self._write(event)

    def _register_channels(self) -> None:
        """Describe every topic of the version, used or not, ahead of the first message."""
        topics: dict[str, Any] = {
            topic: message_class(name)
            for topic, name in RECORDS.items()
            if SINCE_VERSION.get(topic, 0) <= self._version
        }
        schemas: dict[str, int] = {}
        for topic, kind in {**topics, **FOXGLOVE}.items():
            name = kind.DESCRIPTOR.full_name
            if name not in schemas:
                described = descriptor_set(kind)
                schemas[name] = self._writer.register_schema(name, "protobuf", described)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schemas[name])
        grid = message_class("SdfGrid")  # so that the file describes its attachment too
        self._writer.register_schema(grid.DESCRIPTOR.full_name, "protobuf", descriptor_set(grid))

    def _write(self, event: Event) -> None:
        match event:
            case SessionStarted():
                self._write_session(event)
            case RigDescribed():
                self._record("/rig", event.step, rig_values(event))
                self._writer.flush()  # so that it is read, or lost, apart from what follows
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
        for name, data in ((MESH, mesh_to_ply(event.mesh)), (SDF_GRID, sdf_to_bytes(event.sdf))):
            self._writer.add_attachment(0, 0, name, MEDIA_TYPES[name], data)
        self._sdf_digest = event.sdf.digest
        self._scene = SceneMessages(simple_mesh(event.mesh))
        named = ("runner", "object", "session", "method", "seed", "free_resolution")
        values = {name: getattr(event, name) for name in (*named, "world_from_object")}
        values["format_version"] = self._version
        values["config"] = config_to_json(event.config)
        values["workspace"] = event.workspace.bounds
        values["environment"] = [{"name": k, "value": v} for k, v in event.environment.items()]
        values["mesh_digest"] = mesh_digest(event.mesh)
        values["sdf_digest"] = event.sdf.digest
        values["source"] = event.source
        self._record("/session", BEFORE_ALL_STEPS, values)
        for topic in STARTING_EMPTY:
            time = self._time(BEFORE_ALL_STEPS)
            self._add(topic, time, empty_cloud(time))
        self._write_points(BEFORE_ALL_STEPS, KnownPoints(), event.initial_points)
        if event.world_from_object is not None:
            time = self._time(BEFORE_ALL_STEPS)
            self._add("/object_pose", time, object_in_world(event.world_from_object, time))
            for name in ("object_mesh", "object_surface"):
                time = self._time(BEFORE_ALL_STEPS)
                self._add(f"/{name}", time, getattr(self._scene, name)(time))
        self._writer.flush()

    def _write_probe(self, event: Probe) -> None:
        assert self._points is not None
        named = ("outcome", "gripper_path", "contacts", "contact_normals")
        self._record("/probe", event.step, {name: getattr(event, name) for name in named})
        self._write_points(event.step, self._points, event.new_points)
        if len(event.gripper_path) > 0:
            time = self._time(event.step)
            self._add("/gripper_path", time, poses_in_world(event.gripper_path, time))

    def _write_points(self, step: int, old: KnownPoints, new: KnownPoints) -> None:
        """New points, class by class, and then what is known with them."""
        known = np.column_stack([new.known, new.sdf])
        clouds = {"/points/free": new.free, "/points/occupied": new.occupied}
        for topic, points in {**clouds, "/points/known": known}.items():
            if len(points) > 0:
                time = self._time(step)
                self._add(topic, time, point_cloud(points, time))
        self._points = old.merged(new)
        values: dict[str, Any] = {}
        for name in ("free", "occupied", "known"):
            values[f"new_{name}"] = len(getattr(new, name))
            values[name] = len(getattr(self._points, name))
        values |= {"new_digest": new.digest, "digest": self._points.digest}
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
        if problem.points.digest != self._points.digest or problem.sdf.digest != self._sdf_digest:
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
            for name in ("hypothesis_meshes", "hypothesis_surfaces"):
                time = self._time(event.step)
                self._add(f"/{name}", time, getattr(self._scene, name)(found, time))

    def _record(self, topic: str, step: int, values: dict[str, Any]) -> bytes:
        """Write a message of the project's own; its bytes."""
        values = values if topic == "/contents" else {"step": step, **values}
        data = encode(RECORDS[topic], values)
        self._add(topic, self._time(step), data)
        return data

    def _time(self, step: int) -> int:
        """Log time of the next message."""
        return (step - BEFORE_ALL_STEPS) * STEP_TIME + self._count

    def _add(self, topic: str, time: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], time, data, time, sequence=self._count)
        self._count += 1

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
