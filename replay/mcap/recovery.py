"""Everything whole in a damaged or unfinished recording, as a finished one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from chsel.errors import RecordingError
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from replay.files import new_file
from replay.lost_attachment import LostAttachment
from replay.mcap.decision_messages import RecordedDecision
from replay.mcap.event_reader import Entry, RecordedProblem
from replay.mcap.file import StoredMessage
from replay.mcap.foxglove_messages import TOPIC_SCHEMAS
from replay.mcap.gap_reader import WRONG, GapReader
from replay.mcap.reader import read_recording
from replay.mcap.records import Damage
from replay.mcap.salvage import Gap, Salvage
from replay.mcap.schemas import STEP_TIME
from replay.mcap.sensor_messages import ImagePlace
from replay.mcap.texts import one_line
from replay.mcap.validation import RECOVERED, EventOrder
from replay.mcap.writer import McapRecorder

_OF_REGISTRATION = (Traced, SnapshotTaken, HypothesesFound)
_OF_POINTS = ("/points/free", "/points/occupied", "/points/known", "/known_points")


@dataclass
class Recovered:
    """What a recovery kept and what is lost."""

    damage: str | None = None  # why the file cannot be read as it is; None if it can
    damages: list[Damage] = field(default_factory=list)  # bytes that cannot be believed
    probes: list[int] = field(default_factory=list)  # steps of those kept
    problems: list[int] = field(default_factory=list)  # likewise
    results: list[int] = field(default_factory=list)  # likewise
    images: int = 0  # how many are kept
    ended: str | None = None  # outcome, if the end of the session is kept
    messages: int = 0  # how many are known to be missing
    events: list[str] = field(default_factory=list)  # lost for other reasons than missing bytes
    complete: bool = False  # whether the list of contents was there, so that all losses are known
    lost_probes: list[tuple[int, int]] = field(default_factory=list)
    """First and last of steps in a row; without the list of contents, those that may be lost."""
    lost_problems: list[int] = field(default_factory=list)  # steps; without the list, those known
    lost_results: list[int] = field(default_factory=list)  # likewise
    attachments: list[str] = field(default_factory=list)  # names of those lost
    remade: list[str] = field(default_factory=list)  # of those that were made again, to the bit

    @property
    def nothing_lost(self) -> bool:
        """Whether all that the recording ever held is kept."""
        lost = self.messages or self.events or self.lost_probes or self.attachments
        return self.complete and not lost


def recover(path: Path, out: Path) -> Recovered:
    """Write a finished recording of all that is whole in another one.

    A lost SDF grid is made again from the mesh if that gives its digest. Without the mesh, or the
    grid, all else is kept. Raises RecordingError if the session's start is not whole, without which
    nothing makes sense; if `path` is no recording; or if `out` exists or cannot be written.
    """
    with new_file(out) as beside:
        recovery = _Recovery(path)
        recorder = McapRecorder(beside)
        flushed = -1
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
        self._order = EventOrder()
        self._lost_steps: set[int] = set()  # of registrations
        self._blind = False  # whether images are lost with their rig
        self._undecided = False  # whether decisions are lost with the actions offered

    def events(self) -> Iterator[Event]:
        """Each event as it was; where some are lost, a warning; an end where there is none."""
        try:
            for _ in (recording := read_recording(self._path)).events():
                """Every digest of a problem is compared."""
        except RecordingError as error:
            if not self._path.is_file():
                raise
            named = f"recording {self._path}: "
            content = f"cannot be read: {str(error).removeprefix(named)}"
            self.found.damage = getattr(error, "damage", content)
            yield from self._counted(self._salvaged())
        else:
            self.found.complete = True
            yield from self._counted(recording.events())

    def _counted(self, events: Iterator[Event]) -> Iterator[Event]:
        """The events, noted down."""
        found = self.found
        for event in events:
            match event:
                case Probe():
                    found.probes.append(event.step)
                case ProblemPosed():
                    found.problems.append(event.step)
                case HypothesesFound():
                    found.results.append(event.step)
                case SensorImage():
                    found.images += 1
                case SessionEnded() if found.ended is None:
                    found.ended = event.outcome
            yield event

    def _salvaged(self) -> Iterator[Event]:
        self._file = file = Salvage(self._path, TOPIC_SCHEMAS)
        reader = GapReader(file.attachments, self._path.stat().st_size)
        unsure: list[tuple[int, int]] = []  # first and last step of those with missing messages
        gap = False
        for message in file.messages():
            if isinstance(message, Gap):
                self._check_started(reader)
                self.found.messages += message.messages
                reader.gap()
                gap = True
                yield from self._warning(f"{message.messages} messages are lost here")
                continue
            if gap:
                unsure.append((max(self._order.step, 0), message.log_time // STEP_TIME - 1))
                gap = False
            yield from self._taken(reader, message)
        self._check_started(reader)
        yield from self._end(reader, file)
        self._account(reader, unsure)

    def _taken(self, reader: GapReader, message: StoredMessage) -> Iterator[Event]:
        """The events that a message completes, or a warning if one is lost with it."""
        try:
            reader.take(message)
            entries = reader.drained()
        except WRONG as error:
            if reader.start is None:
                raise RecordingError(f"{self._nothing()}: {one_line(str(error))}") from error
            reader.gap()
            entries = []
            if message.topic not in _OF_POINTS or not self.found.messages:
                step = message.log_time // STEP_TIME - 1
                yield from self._lost(f"{message.topic} of step {step}: {one_line(str(error))}")
            # else its probe was lost with the messages before it
        for entry in entries:
            if isinstance(entry, SessionStarted):
                self._note_attachments(entry, reader)
            yield from self._kept(reader, entry)

    def _kept(self, reader: GapReader, entry: Entry) -> Iterator[Event]:
        """The event, if it still makes sense where it is; else a warning, once a registration."""
        step = entry.step
        if isinstance(entry, ImagePlace):
            return  # there is none of them here
        if isinstance(entry, SensorImage) and not self._order.has_rig:
            if not self._blind:
                self._blind = True
                yield from self._lost("all images of sensors: their rig was lost before")
            return
        if isinstance(entry, RecordedDecision) and not self._order.has_actions:
            if not self._undecided:
                self._undecided = True
                yield from self._lost("all decisions: the actions offered were lost before")
            return
        if isinstance(entry, _OF_REGISTRATION) and step in self._lost_steps:
            return  # with its problem
        try:
            event = reader.completed(entry)
            self._order.take(event.topic, event.step)
        except WRONG as error:
            what, reason = f"{type(entry).__name__} of step {step}", one_line(str(error))
            if isinstance(entry, (RecordedProblem, *_OF_REGISTRATION)):
                self._lost_steps.add(step)
                what = f"the registration of step {step}"
            elif isinstance(entry, RecordedDecision):
                what = f"the decision after step {step}"
            if isinstance(entry, (RecordedProblem, RecordedDecision, *_OF_REGISTRATION)):
                reason = "something it needs was lost before" if reader.wanting else reason
            yield from self._lost(f"{what}: {reason}")
        else:
            yield event

    def _end(self, reader: GapReader, file: Salvage) -> Iterator[Event]:
        """What a recording without its end needs."""
        self.found.damages = file.damages
        self.found.complete = reader.closed
        if reader.within is not None:
            yield from self._lost(f"the last event on {reader.within}: its points are missing")
        if not reader.closed and file.rest is not None:
            yield from self._warning(f"what followed is lost, {file.rest.reason}")
        if self.found.ended is None:
            yield SessionEnded(self._order.step, f"{RECOVERED}how the session ended is not known")
            self.found.ended = None  # that was no outcome

    def _account(self, reader: GapReader, unsure: Sequence[tuple[int, int]]) -> None:
        """Which steps are lost: as the contents say, or else as far as can be known."""
        found = self.found
        kept = sorted(set(found.probes))
        if not reader.closed:
            found.lost_problems = sorted(self._lost_steps)
            found.lost_probes = [s for first, last in unsure for s in _without(first, last, kept)]
            return
        listed = reader.rows
        lost = Counter(row.step for row in listed) - Counter(found.probes)
        found.lost_probes = _in_a_row(sorted(lost))
        found.lost_problems = _missing((r.step for r in listed if r.posed), found.problems)
        found.lost_results = _missing((r.step for r in listed if r.hypotheses >= 0), found.results)

    def _lost(self, what: str) -> Iterator[Event]:
        self.found.events.append(what)
        return self._warning(f"lost: {what}")

    def _warning(self, text: str) -> Iterator[Event]:
        """A line in the recording; behind the session's end there can be none."""
        if self.found.ended is None:
            warning = Logged(self._order.step, "warning", f"{RECOVERED}{text}")
            self._order.take(warning.topic, warning.step)
            yield warning

    def _note_attachments(self, start: SessionStarted, reader: GapReader) -> None:
        for part in (start.mesh, start.sdf):
            if isinstance(part, LostAttachment):
                self.found.attachments.append(part.name)
        self.found.remade = reader.remade

    def _check_started(self, reader: GapReader) -> None:
        """Raise RecordingError if the session's start is not there by now."""
        if reader.start is None:
            raise RecordingError(f"{self._nothing()}: the start of its session is not there")

    def _nothing(self) -> str:
        """What is wrong if there is no session, with the first damage, which is why."""
        damages = self._file.damages[:1]
        where = [f" (bytes {d.start} to {d.end}: {d.reason})" for d in damages]
        return f"nothing can be recovered from {self._path}{''.join(where)}"


def _missing(steps: Iterable[int], kept: Iterable[int]) -> list[int]:
    return sorted(set(steps) - set(kept))


def _in_a_row(steps: Sequence[int]) -> list[tuple[int, int]]:
    """Steps in ascending order, as first and last of those in a row."""
    pairs: list[tuple[int, int]] = []
    for step in steps:
        if pairs and step == pairs[-1][1] + 1:
            pairs[-1] = (pairs[-1][0], step)
        else:
            pairs.append((step, step))
    return pairs


def _without(first: int, last: int, kept: Sequence[int]) -> list[tuple[int, int]]:
    """Steps from first to last that are not among those kept, which are in ascending order."""
    pairs = []
    for step in kept:
        if first <= step <= last:
            pairs.append((first, step - 1))
            first = step + 1
    return [pair for pair in [*pairs, (first, last)] if pair[0] <= pair[1]]
