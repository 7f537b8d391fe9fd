"""The whole parts of a damaged or unfinished recording, as a finished one."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
from chsel.problem.sdf_grid import OBJECT_PADDING, SdfGrid, object_grid
from replay.files import new_file
from replay.mcap.attachments import mesh_attached, sdf_attached, sdf_to_bytes
from replay.mcap.encoding import decode, encode
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

if TYPE_CHECKING:
    import trimesh

_PARTS = {
    "the registration": ("/problem", "/trace", "/archive", "/hypotheses"),
    "the probe": ("/probe", "/known_points", *CLOUDS),
}
_WRONG = (ChselError, ValueError, RecursionError)  # what reading a message may raise


@dataclass
class Recovered:
    """The parts of a recording that a recovery kept, and those that are lost."""

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
    them is kept. A damaged SDF grid is made again from the mesh; if that does not give its digest,
    the registrations and decisions on it are lost, and all else is kept. Raise RecordingError if
    the rest of the session's start is not whole, without which nothing makes sense; if `path` is
    not a recording; or if `out` exists or cannot be written.
    """
    recovery = _Recovery(path)
    with new_file(out) as beside:
        recorder = McapRecorder(beside)
        flushed = BEFORE_ALL_STEPS
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
    """Return whether an event stands where a recovery could not keep what had been recorded."""
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
        self._another_grid = ""  # why the grid is not that of the session; "" if it is

    def events(self) -> Iterator[Event]:
        """Yield each event, a warning where some are lost, and an end where there is none."""
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
        """Yield all whole messages in the order of writing, and what is lost where, and why."""
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
                    messages, missing = file.later_messages(chunk_at(stream, size, place=begin))
                except MALFORMED as error:
                    yield f"bytes {begin} to {begin + chunk.chunk_length}", reason_of(error)
                    continue
                if missing:
                    yield f"{missing} messages before byte {begin}", "they were in damaged bytes"
                yield from messages

    def _taken(self, message: StoredMessage) -> Iterator[Event]:
        """Yield the event that a message completes, if it still makes sense where it is."""
        topic = message.topic
        step = message.log_time // STEP_TIME - 1
        if topic == "/session":
            message = self._with_grid(message)
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
            if event is self._start and self._another_grid:
                yield from self._lost("the SDF grid", self._another_grid)

    def _completed(self, entry: Entry, message: StoredMessage) -> Event:
        """Return it with its whole problem; raise RecordingError if a part of that is lost."""
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
        return entry.completed(self._start, self._offered, points=points)

    def _note(self, event: Event) -> None:
        match event:
            case SessionStarted():
                self._start = event
                self._points = event.initial_points
            case ActionsOffered():
                self._offered = event
            case Probe():
                self._points = event.added_to(self._points)
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
        """Yield a line of the log where something is lost; nothing behind the end."""
        if what not in self.found.lost:
            self.found.lost[what] = reason
            if self._start is not None and not self.found.ended:
                yield Logged(self._order.step, "warning", text=f"{RECOVERED}lost: {what}: {reason}")

    def _with_grid(self, message: StoredMessage) -> StoredMessage:
        """Return the session's message; a damaged SDF grid is made again as far as that can be.

        If no grid of the mesh has the digest, one stands in, and the message names it: the session
        can then be read, and what depends on the grid shows by its digest that it is another.
        """
        attachments = self._file.attachments
        values: dict[str, Any] = {}
        with suppress(*_WRONG):
            values = decode("Session", message.data)
            sdf_attached(attachments, values["sdf_digest"])
            return message
        with suppress(*_WRONG, LookupError, TypeError):
            mesh = mesh_attached(attachments, values["mesh_digest"])
            stand_in = None
            for grid in _grids(mesh, values["config"], attachments=attachments):
                stand_in = stand_in or grid
                self.found.remade = grid.digest == values["sdf_digest"]
                if self.found.remade:
                    attachments[SDF_GRID] = sdf_to_bytes(grid)
                    return message
            if stand_in is not None:
                self._another_grid = "it is damaged, and the mesh gives another, which stands in"
                attachments[SDF_GRID] = sdf_to_bytes(stand_in)
                data = encode("Session", values | {"sdf_digest": stand_in.digest})
                return replace(message, data=data)
        return message

    def _nothing(self, reason: str) -> str:
        damage = self._file.damage
        return f"nothing can be recovered from {self._path}: {reason}" + (
            f"; it is {damage}" if damage else ""
        )


def _grids(
    mesh: trimesh.Trimesh, config: str, *, attachments: Mapping[str, bytes]
) -> Iterator[SdfGrid]:
    """Yield grids that the session may have had: configured, default, as the damaged one begins."""
    ways: list[tuple[float | None, float]] = [(None, OBJECT_PADDING)]
    with suppress(*_WRONG, LookupError, TypeError):
        session = config_from_json(config)["session"]
        ways.insert(0, (session["object_resolution"], session["object_padding"]))
    with suppress(*_WRONG, LookupError, TypeError):
        damaged = decode("SdfGrid", attachments[SDF_GRID])
        padding = round(float(np.max(mesh.bounds[0] - damaged["origin"])), 9)
        ways.append((float(damaged["resolution"]), padding))
    for resolution, padding in dict.fromkeys(ways):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the session gave those about its grid
            try:
                grid = object_grid(mesh, resolution, padding=padding)
            except _WRONG:
                continue
        yield grid
