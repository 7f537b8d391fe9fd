"""What is whole in a damaged or unfinished recording, as a finished one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from chsel.errors import ChselError, RecordingError
from chsel.events import (
    ActionsOffered,
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionEnded,
    SessionStarted,
)
from chsel.problem.points import KnownPoints
from chsel.problem.sdf_grid import object_grid
from replay.files import new_file
from replay.mcap.attachments import mesh_attached, sdf_attached, sdf_to_bytes
from replay.mcap.encoding import decode
from replay.mcap.event_messages import (
    ImagePlace,
    RecordedDecision,
    RecordedProblem,
    config_from_json,
    image_from,
)
from replay.mcap.event_reader import Entry, EventReader
from replay.mcap.file import (
    MALFORMED,
    McapFile,
    StoredMessage,
    chunk_at,
    file_summary,
    opened,
    reason_of,
)
from replay.mcap.foxglove_messages import CLOUDS, TOPIC_SCHEMAS
from replay.mcap.schemas import BEFORE_ALL_STEPS, RECORDS, SDF_GRID, STEP_TIME
from replay.mcap.texts import one_line
from replay.mcap.validation import RECOVERED, EventOrder
from replay.mcap.writer import McapRecorder

_PARTS = {
    "the registration": ("/problem", "/trace", "/archive", "/hypotheses"),
    "the probe": ("/probe", "/known_points", *CLOUDS),
}
_WRONG = (ChselError, ValueError, RecursionError)  # what reading a message may raise


@dataclass
class Recovered:
    """What a recovery kept and what is lost."""

    damage: str | None = None  # why the file cannot be read as it is; None if it can
    probes: list[int] = field(default_factory=list)  # steps of those kept
    problems: list[int] = field(default_factory=list)  # likewise
    results: list[int] = field(default_factory=list)  # likewise
    images: int = 0  # how many are kept
    ended: bool = False  # whether the end of the session is kept
    remade: bool = False  # whether the SDF grid was damaged and is there again, to the bit
    lost: dict[str, str] = field(default_factory=dict)  # what is known to be lost, and why


def recover(path: Path, out: Path) -> Recovered:
    """Write a finished recording of all that is whole in another one.

    That is everything up to the first damage, and in a finished file also each later chunk that its
    index names and whose checksum is right. Of what follows lost messages, only what does not need
    them is kept. A damaged SDF grid is made again from the mesh if that gives its digest. Raises
    RecordingError if the session's start is not whole, without which nothing makes sense; if `path`
    is not a recording; or if `out` exists or cannot be written.
    """
    recovery = _Recovery(path)
    with new_file(out) as beside:
        recorder, flushed = McapRecorder(beside), BEFORE_ALL_STEPS
        try:
            for event in recovery.events():
                if isinstance(event, Probe | SensorImage) and event.step > flushed:
                    recorder.flush()  # as a session does, so that a chunk holds one probe
                    flushed = event.step
                recorder.record(event)
        finally:
            recorder.close()
    return recovery.found


def tells_loss(event: Event) -> bool:
    """Whether an event stands where a recovery could not keep what had been recorded."""
    return (
        isinstance(event, Logged) and event.level == "warning" and event.text.startswith(RECOVERED)
    )


class _Recovery:
    """The events of a file that are worth keeping, and what is found on the way."""

    def __init__(self, path: Path) -> None:
        self.found = Recovered()
        self._path = path
        self._file = McapFile(path, TOPIC_SCHEMAS, partial=True)
        self._reader = EventReader(self._file.attachments)
        self._order = EventOrder()
        self._points = KnownPoints()  # those that are kept
        self._start: SessionStarted | None = None
        self._offered: ActionsOffered | None = None

    def events(self) -> Iterator[Event]:
        """Each event as it was; where some are lost, a warning; an end where there is none."""
        for part in self._parts():
            if isinstance(part, StoredMessage):
                yield from self._taken(part)
            else:
                self._reader.skip()
                yield from self._lost(*part)
        if self._start is None:
            raise RecordingError(self._nothing("the start of its session is not there"))
        if self._reader.within is not None:
            yield from self._lost(f"the last {self._reader.within}", "it is cut")
        if not self.found.ended:
            yield SessionEnded(self._order.step, f"{RECOVERED}how the session ended is not known")

    def _parts(self) -> Iterator[StoredMessage | tuple[str, str]]:
        """All whole messages in the order of writing, and what is lost between them, and why."""
        file = self._file
        yield from file.messages()
        self.found.damage = file.damage
        if file.damage is None:
            return
        with opened(self._path) as stream:
            size = stream.seek(0, 2)
            summary = file_summary(stream, size)
            if summary is None:
                if file.place < size:
                    yield f"bytes {file.place} to {size}", "they are not whole, and have no index"
                return
            for chunk in sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset):
                begin = chunk.chunk_start_offset
                if begin < file.place:
                    continue
                try:
                    messages, missing = file.later_messages(chunk_at(stream, size, begin))
                except MALFORMED as error:
                    yield f"bytes {begin} to {begin + chunk.chunk_length}", reason_of(error)
                    continue
                if missing:
                    yield f"{missing} messages before byte {begin}", "they were in damaged bytes"
                yield from messages

    def _taken(self, message: StoredMessage) -> Iterator[Event]:
        """The event that a message completes, if it still makes sense where it is."""
        topic, step = message.topic, message.log_time // STEP_TIME - 1
        if topic == "/session":
            self._remake_grid(message)
        try:
            entry = self._reader.take(message)
            if entry is None:
                return
            event = self._completed(entry, message)
            self._order.take(event.topic, event.step)
        except _WRONG as error:
            if self._start is None:
                raise RecordingError(self._nothing(one_line(str(error)))) from error
            self._reader.skip()
            kind = next((name for name, topics in _PARTS.items() if topic in topics), topic)
            yield from self._lost(f"{kind} of step {step}", one_line(str(error)))
        else:
            self._note(event)
            yield event

    def _completed(self, entry: Entry, message: StoredMessage) -> Event:
        """With its whole problem; RecordingError if something of lost messages is missing."""
        if isinstance(entry, ImagePlace):
            return image_from(decode(RECORDS[entry.topic], message.data))
        if not isinstance(entry, RecordedProblem | RecordedDecision):
            return entry
        assert self._start is not None
        points = self._points
        if isinstance(entry, RecordedProblem):
            return ProblemPosed(entry.step, entry.completed(self._start.sdf, points))
        if self._offered is None:
            raise RecordingError("the actions offered were lost before")
        return entry.completed(self._start, self._offered, points)

    def _note(self, event: Event) -> None:
        match event:
            case SessionStarted():
                self._start, self._points = event, event.initial_points
            case ActionsOffered():
                self._offered = event
            case Probe():
                self._points = self._points.merged(event.new_points)
                self.found.probes.append(event.step)
            case ProblemPosed():
                self.found.problems.append(event.step)
            case HypothesesFound():
                self.found.results.append(event.step)
            case SensorImage():
                self.found.images += 1
            case SessionEnded():
                self.found.ended = True

    def _lost(self, what: str, reason: str) -> Iterator[Event]:
        """A line in the recording where something is lost; behind the end there can be none."""
        if what not in self.found.lost:
            self.found.lost[what] = reason
            if self._start is not None and not self.found.ended:
                yield Logged(self._order.step, "warning", f"{RECOVERED}lost: {what}: {reason}")

    def _remake_grid(self, message: StoredMessage) -> None:
        """Make a damaged SDF grid again as the session's configuration says, if that can be."""
        attachments = self._file.attachments
        values: dict[str, Any] = decode("Session", message.data)
        with suppress(*_WRONG):
            sdf_attached(attachments, values["sdf_digest"])
            return
        with suppress(*_WRONG, LookupError, TypeError):
            mesh = mesh_attached(attachments, values["mesh_digest"])
            session = config_from_json(values["config"])["session"]
            padding = session["object_padding"]
            grid = object_grid(mesh, session["object_resolution"], padding=padding)
            self.found.remade = grid.digest == values["sdf_digest"]
            attachments[SDF_GRID] = sdf_to_bytes(grid)

    def _nothing(self, reason: str) -> str:
        damage = self._file.damage
        return f"nothing can be recovered from {self._path}: {reason}" + (
            f"; it is {damage}" if damage else ""
        )
