"""Joins the messages of a recording to the events that they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from chsel.errors import RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from replay.events import (
    ActionsOffered,
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionStarted,
    SnapshotTaken,
)
from replay.lost_attachment import LostAttachment
from replay.mcap.attachments import MESH, SDF_GRID, attached
from replay.mcap.contents import Contents
from replay.mcap.decision_messages import RecordedDecision, decision_from
from replay.mcap.encoding import check_message, decode, message_class, shared_arguments
from replay.mcap.event_messages import (
    archive_from,
    event_from,
    problem_from,
    session_from,
)
from replay.mcap.file import StoredMessage
from replay.mcap.foxglove_messages import CLOUDS, VIEWS, cloud_points, log_level_and_text
from replay.mcap.schemas import (
    BEFORE_ALL_STEPS,
    FORMAT_VERSION,
    RECORDS,
    SEALED_SINCE,
    SINCE_VERSION,
    STEP_TIME,
)
from replay.mcap.seal import CONTENTS, SEAL
from replay.mcap.sensor_messages import ImagePlace, check_pixels, plausible_pixels
from replay.mcap.validation import EventOrder, check_cells, check_digest
from replay.mcap.wire import parsed

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, eq=False)
class RecordedProblem:
    """A problem without its points and grid, which the events before it give."""

    topic: ClassVar[str] = ProblemPosed.topic

    values: Mapping[str, Any]  # of the message `Problem`, the low-cost set included

    @property
    def step(self) -> int:
        """Of the registration."""
        return int(self.values["step"])

    @property
    def seed(self) -> int:
        """Of the random streams."""
        return int(self.values["key_seed"])

    def completed(self, sdf: SdfGrid, points: KnownPoints) -> RegistrationProblem:
        """The whole problem; RecordingError unless it is the one that was recorded."""
        problem = problem_from(self.values, sdf, points)
        check_digest(f"the problem of step {self.step}", problem.digest, self.values["digest"])
        recorded = self.values["points_digest"]
        check_digest(f"all points of step {self.step}", points.digest, recorded)
        return problem


Entry = Event | RecordedProblem | RecordedDecision | ImagePlace
"""An event, or what is kept of one that takes more than its message to make."""


class EventReader:
    """Joins messages to events. `within` is the topic of an event whose points are yet to come.

    version: of the file's format, once its session has started.
    size: of the file, bytes, by which it is judged how many pixels it can plausibly hold.
    """

    def __init__(self, attachments: dict[str, bytes], size: int) -> None:
        self.entries: list[Entry] = []
        self.within: str | None = None
        self.contents = Contents()
        self.closed = False  # whether the contents, which come last, were there
        self._pixels = plausible_pixels(size)  # that are left
        self.version = FORMAT_VERSION
        self._order = EventOrder()
        self._sdf_digest = ""
        self._points_digest = ""  # of all points known so far, as recorded
        self._attachments = attachments
        self._opening: dict[str, Any] = {}
        self._clouds: dict[str, FloatArray] = {}
        self._counts = {"free": 0, "occupied": 0, "known": 0}
        self._last_snapshot: ArchiveSnapshot | None = None
        self._last_elites: FloatArray | None = None
        self._offered: ActionsOffered | None = None

    def take(self, message: StoredMessage) -> None:
        """Read one message. Raises RecordingError if it is malformed or out of place."""
        topic, data = message.topic, message.data
        if topic in VIEWS:
            return
        if topic == SEAL and self.version >= SEALED_SINCE and not self.closed:
            return  # compared by whoever reads the file
        if not self._fits(topic):
            raise RecordingError(f"a message on {topic} is out of place")
        step = message.log_time // STEP_TIME - 1
        if topic in CLOUDS:
            _check_step(topic, self._opening.get("step", BEFORE_ALL_STEPS), step)
            self._clouds[topic] = cloud_points(data, CLOUDS[topic])
        elif topic == "/log":
            self._append(Logged(step, *log_level_and_text(data)))
        elif topic == CONTENTS:
            self._compare_contents(data)
        else:
            if topic == "/session":
                self.version = _checked_version(data)
            values = decode(RECORDS[topic], data)
            _check_step(topic, values.get("step", step), step)
            check_message(RECORDS[topic], values)
            if topic in ("/session", "/probe"):
                self.within, self._opening = topic, values
            else:
                self._append(self._event(topic, values))

    def _fits(self, topic: str) -> bool:
        """Whether a message on this topic can follow the ones before it."""
        if self.closed:
            return False
        if self.within is not None:
            return topic == "/known_points" or (topic in CLOUDS and topic not in self._clouds)
        if not self.entries:
            return topic == "/session"
        if SINCE_VERSION.get(topic, 0) > self.version:
            return False
        return topic not in (*CLOUDS, "/known_points", "/session")

    def _append(self, entry: Entry) -> None:
        self._order.take(entry.topic, entry.step)
        if isinstance(entry, RecordedProblem):
            self.contents.pose(entry.step)
        elif not isinstance(entry, RecordedDecision | ImagePlace):
            self.contents.take(entry)
        self.entries.append(entry)

    def _compare_contents(self, data: bytes) -> None:
        """The last message says again what came before it."""
        self.closed = True
        recorded = decode(RECORDS[CONTENTS], data)
        for name, column in self.contents.values().items():
            if recorded[name].tobytes() != column.tobytes():
                raise RecordingError(f"its contents, as read, have another {name} than recorded")

    def _event(self, topic: str, values: dict[str, Any]) -> Entry:
        match topic:
            case "/known_points":
                return self._close(values)
            case "/sensor_image":
                return self._image(values)
            case "/problem":
                return self._problem(values)
            case "/archive":
                self._last_snapshot = archive_from(values)
                return SnapshotTaken(values["step"], self._last_snapshot)
            case "/hypotheses":
                return self._hypotheses(values)
            case "/decision":
                return self._decision(values)
            case _:
                event = event_from(topic, values)
                if isinstance(event, ActionsOffered):
                    self._offered = event
                return event

    def _close(self, values: dict[str, Any]) -> SessionStarted | Probe:
        """The event that was open, now that its points are there."""
        clouds = {
            topic: self._clouds.pop(topic, np.zeros((0, columns)))
            for topic, columns in CLOUDS.items()
        }
        free, occupied, known = clouds.values()
        points = KnownPoints(free, occupied, known[:, :3], known[:, 3])
        for name in self._counts:
            count = len(getattr(points, name))
            self._counts[name] += count
            if (count, self._counts[name]) != (values[f"new_{name}"], values[name]):
                raise RecordingError(f"{name} points of step {values['step']} are missing")
        check_digest(f"new points of step {values['step']}", points.digest, values["new_digest"])
        if values["step"] != self._opening.get("step", BEFORE_ALL_STEPS):
            raise RecordingError(f"the points of step {values['step']} follow another probe")
        self._points_digest = values["digest"]
        topic, self.within = self.within, None
        if topic == "/session":
            self._sdf_digest = self._opening["sdf_digest"]
            mesh = self._attached(MESH, self._opening["mesh_digest"])
            sdf = self._attached(SDF_GRID, self._sdf_digest)
            return session_from(self._opening, points, mesh, sdf)
        return Probe(**shared_arguments(Probe, self._opening), new_points=points)

    def _attached(self, name: str, digest: str) -> Any:
        """The mesh or the grid; RecordingError unless it is there as recorded, or known as lost."""
        if name not in self._attachments and name in self._opening["lost"]:
            return LostAttachment(name, digest)
        return attached(self._attachments, name, digest)

    def _image(self, values: dict[str, Any]) -> ImagePlace | SensorImage:
        """The place of an image: all of them would fill the memory."""
        self._count_pixels(values)
        return ImagePlace(values["step"])

    def _count_pixels(self, values: dict[str, Any]) -> None:
        """Raise RecordingError if an image is wrong from outside, or one too many to look at."""
        check_pixels(values)
        self._pixels -= values["height"] * values["width"]
        if self._pixels < 0:
            raise RecordingError("its images have more pixels than a file of its size can hold")

    def _problem(self, values: dict[str, Any]) -> RecordedProblem:
        step = values["step"]
        if values["low_cost_set"] is None:
            if self._last_elites is None:
                raise RecordingError(f"the low-cost set of step {step} is missing")
            values["low_cost_set"] = self._last_elites
        if self.version < SEALED_SINCE:
            before = f"all points before the problem of step {step}"
            check_digest(before, self._points_digest, values["points_digest"])
        grid = f"the SDF grid of the problem of step {step}"
        check_digest(grid, self._sdf_digest, values["sdf_digest"])
        return RecordedProblem(values)

    def _decision(self, values: dict[str, Any]) -> RecordedDecision:
        entry = decision_from(values)
        if self._offered is not None:  # else it is out of place
            entry.check_actions(self._offered)
        return entry

    def _hypotheses(self, values: dict[str, Any]) -> HypothesesFound:
        step, archive = values["step"], values["archive"]
        if archive is not None:
            archive = archive_from(archive)
        elif values["archive_is_last_snapshot"]:
            archive = self._last_snapshot
            if archive is None:
                raise RecordingError(f"the archive of step {step} is missing")
            check_cells(values["cell"], archive.shape)
        found = Hypotheses(**shared_arguments(Hypotheses, values | {"archive": archive}))
        check_digest(f"the hypotheses of step {step}", found.digest, values["digest"])
        self._last_elites = found.elites
        return HypothesesFound(step, found)


def _check_step(topic: str, step: int, timed: int) -> None:
    if step != timed:
        raise RecordingError(f"a message on {topic} has a time of step {timed}, not its own")


def _checked_version(data: bytes) -> int:
    """The format of a session; RecordingError for one not known, before reading more of it."""
    session = parsed(message_class("Session"), data)
    version = int(session.format_version)
    if version > FORMAT_VERSION:
        raise RecordingError(
            f"written by a newer version: format {version}; this one reads up to {FORMAT_VERSION}"
        )
    if version < 1:
        raise RecordingError(f"it has format version {version}; accepted: 1 to {FORMAT_VERSION}")
    return version
