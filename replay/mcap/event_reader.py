"""Joins the messages of a recording to the events that they were."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from chsel.errors import RecordingError
from chsel.events import Event, HypothesesFound, Logged, Probe, SessionStarted, SnapshotTaken
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import POINT_CLASSES, KnownPoints
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from replay.mcap.attachments import mesh_attached, sdf_attached
from replay.mcap.encoding import check_message, decode, message_class, parsed, shared_arguments
from replay.mcap.event_messages import (
    ImagePlace,
    RecordedDecision,
    RecordedProblem,
    archive_from,
    decision_from,
    event_from,
    session_from,
)
from replay.mcap.file import StoredMessage
from replay.mcap.foxglove_messages import CLOUDS, VIEWS, cloud_points, log_level_and_text
from replay.mcap.schemas import BEFORE_ALL_STEPS, FORMAT_VERSION, RECORDS, STEP_TIME
from replay.mcap.validation import EventOrder, check_cells, check_digest

Entry = Event | RecordedProblem | RecordedDecision | ImagePlace
"""An event, or what is kept of one that takes more than its message to make."""


class EventReader:
    """A reader that joins messages to events."""

    def __init__(self, attachments: Mapping[str, bytes]) -> None:
        """Start before any event. attachments: those of the file by name, there at its first."""
        self.within: str | None = None  # topic of an event whose points are yet to come
        self._attachments = attachments
        self._order = EventOrder()
        self._started = False
        self._sdf_digest = ""
        self._opening: dict[str, Any] = {}
        self._clouds: dict[str, FloatArray] = {}
        self._counts: dict[str, int] | None = dict.fromkeys(POINT_CLASSES, 0)
        self._last_snapshot: ArchiveSnapshot | None = None
        self._last_elites: FloatArray | None = None

    def take(self, message: StoredMessage) -> Entry | None:
        """Return the event that a message completes; raise RecordingError if it is out of place."""
        topic, data = message.topic, message.data
        if topic in VIEWS:
            return None
        if not self._fits(topic):
            raise RecordingError(f"a message on {topic} is out of place")
        step = message.log_time // STEP_TIME - 1
        entry: Entry
        if topic in CLOUDS:
            _check_step(topic, self._opening.get("step", BEFORE_ALL_STEPS), timed=step)
            self._clouds[topic] = cloud_points(data, CLOUDS[topic])
            return None
        if topic == "/log":
            entry = Logged(step, *log_level_and_text(data))
        else:
            if topic == "/session":
                _check_version(data)
            values = decode(RECORDS[topic], data)
            _check_step(topic, values.get("step", step), timed=step)
            check_message(RECORDS[topic], values)
            if topic in ("/session", "/probe"):
                self.within, self._opening = topic, values
                return None
            entry = self._entry(topic, values)
        self._order.take(entry.topic, entry.step)
        return entry

    def skip(self) -> None:
        """Drop the event that missing messages belong to."""
        self.within = None
        self._opening = {}
        self._counts = None
        self._clouds.clear()
        self._last_snapshot = None

    def _fits(self, topic: str) -> bool:
        """Return whether a message on this topic can follow the ones before it."""
        if self.within is not None:
            return topic == "/known_points" or (topic in CLOUDS and topic not in self._clouds)
        if not self._started:
            return topic == "/session"
        return topic not in (*CLOUDS, "/known_points", "/session")

    def _entry(self, topic: str, values: dict[str, Any]) -> Entry:
        match topic:
            case "/known_points":
                return self._close(values)
            case "/sensor_image":
                return ImagePlace(values["step"])  # all of them would fill the memory
            case "/problem":
                return self._problem(values)
            case "/archive":
                self._last_snapshot = archive_from(values)
                return SnapshotTaken(values["step"], self._last_snapshot)
            case "/hypotheses":
                return self._hypotheses(values)
            case "/decision":
                return decision_from(values)
            case _:
                return event_from(topic, values)

    def _close(self, values: dict[str, Any]) -> SessionStarted | Probe:
        """Return the event that was open, now that its points are there."""
        clouds = {
            topic: self._clouds.pop(topic, np.zeros((0, columns)))
            for topic, columns in CLOUDS.items()
        }
        free, occupied, known = clouds.values()
        points = KnownPoints(
            free,
            occupied,
            known=known[:, :3],
            known_sdf=known[:, 3],
            normals=values["normals"],
            normal_noise=values["normal_noise"],
        )
        counts = {name: len(getattr(points, name)) for name in POINT_CLASSES}
        before = {name: values[name] - counts[name] for name in counts}
        withdrawn = self._opening.get("withdrawn")
        if self._counts is not None:
            before = dict(self._counts)
            if withdrawn is not None:
                if withdrawn[-1] >= before["known"]:
                    raise RecordingError(
                        f"step {values['step']} withdraws point {withdrawn[-1]}; accepted: below "
                        f"{before['known']}"
                    )
                before["known"] -= len(withdrawn)
        self._counts = {name: before[name] + count for name, count in counts.items()}
        for name, count in counts.items():
            if (count, self._counts[name]) != (values[f"new_{name}"], values[name]):
                raise RecordingError(f"{name} points of step {values['step']} are missing")
        check_digest(
            f"new points of step {values['step']}", points.digest, recorded=values["new_digest"]
        )
        if values["step"] != self._opening.get("step", BEFORE_ALL_STEPS):
            raise RecordingError(f"the points of step {values['step']} follow another probe")
        topic, self.within = self.within, None
        if topic == "/session":
            self._started = True
            self._sdf_digest = self._opening["sdf_digest"]
            mesh = mesh_attached(self._attachments, self._opening["mesh_digest"])
            sdf = sdf_attached(self._attachments, self._sdf_digest)
            return session_from(self._opening, points, mesh=mesh, sdf=sdf)
        return Probe(**shared_arguments(Probe, self._opening), new_points=points)

    def _problem(self, values: dict[str, Any]) -> RecordedProblem:
        step = values["step"]
        if values["low_cost_set"] is None:
            if self._last_elites is None:
                raise RecordingError(f"the low-cost set of step {step} is missing")
            values["low_cost_set"] = self._last_elites
        grid = f"the SDF grid of the problem of step {step}"
        check_digest(grid, self._sdf_digest, recorded=values["sdf_digest"])
        return RecordedProblem(values)

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
        check_digest(f"the hypotheses of step {step}", found.digest, recorded=values["digest"])
        self._last_elites = found.elites
        return HypothesesFound(step, found)


def _check_step(topic: str, step: int, *, timed: int) -> None:
    if step != timed:
        raise RecordingError(f"a message on {topic} has a time of step {timed}, not its own")


def _check_version(data: bytes) -> None:
    """Raise RecordingError for a format that is not known, before reading more of it."""
    version = parsed(message_class("Session"), data).format_version
    if version != FORMAT_VERSION:
        raise RecordingError(f"it is of format {version}; accepted: {FORMAT_VERSION}")
