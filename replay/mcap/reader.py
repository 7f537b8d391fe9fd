"""Reads a recording back: its events as they were, and every registration problem."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from chsel.errors import ChselError, RecordingError
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    HypothesesFound,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from replay.files import file_digest
from replay.mcap.encoding import decode
from replay.mcap.event_messages import ImagePlace, RecordedDecision, RecordedProblem, image_from
from replay.mcap.event_reader import Entry, EventReader
from replay.mcap.file import DamagedRecordingError, McapFile
from replay.mcap.foxglove_messages import TOPIC_SCHEMAS
from replay.mcap.schemas import RECORDS, STEP_TIME
from replay.mcap.texts import one_line

Placed = TypeVar("Placed", RecordedProblem, RecordedDecision)


class Recording:
    """A session, as its recording has it."""

    def __init__(
        self,
        path: Path,
        entries: list[Entry],
        *,
        damage: str | None,
        attachments: Mapping[str, int],
    ) -> None:
        if not entries or not isinstance(entries[0], SessionStarted):
            why = "" if damage is None else f": it is {damage}"
            raise RecordingError(f"recording {path} has no session in it{why}")
        self.path = path
        self.damage = damage  # what cut reading short, None if the file is whole
        self.attachments = attachments  # bytes of each, by name
        self.start = entries[0]
        # None if the session did not end.
        self.ended = next((entry for entry in entries if isinstance(entry, SessionEnded)), None)
        self.probes = [entry for entry in entries if isinstance(entry, Probe)]  # in their order
        # Those with a registration problem.
        self.steps = tuple(entry.step for entry in entries if isinstance(entry, RecordedProblem))
        # None unless a robot's log was read.
        self.rig = next((entry for entry in entries if isinstance(entry, RigDescribed)), None)
        seen = (entry.step for entry in entries if isinstance(entry, ImagePlace))
        self.image_steps = tuple(dict.fromkeys(seen))  # those with images of sensors
        # The first actions of a steered session, else None.
        self.offered = next((entry for entry in entries if isinstance(entry, ActionsOffered)), None)
        decisions = (entry.step for entry in entries if isinstance(entry, RecordedDecision))
        self.decision_steps = tuple(decisions)  # those before a decision, -1 before the first probe
        self._entries = entries

    def events(self, *, images: bool = True) -> Iterator[Event]:
        """Yield all events in the order in which they were recorded.

        Images are read from the file once more, one at a time, or left out.
        """
        points = self.start.initial_points
        seen = self._images()
        offered = self.offered
        for entry in self._entries:
            if isinstance(entry, Probe):
                points = entry.added_to(points)
            if isinstance(entry, ActionsOffered):
                offered = entry
            if isinstance(entry, RecordedProblem):
                yield ProblemPosed(entry.step, self._completed(entry, points))
            elif isinstance(entry, RecordedDecision):
                yield self._decided(entry, offered, points=points)
            elif not isinstance(entry, ImagePlace):
                yield entry
            elif images:
                yield self._next(seen, entry)

    def start_at(self, step: int) -> SessionStarted:
        """Return the session as it starts, with the true pose after a step."""
        before = [p.world_from_object for p in self.probes if p.step <= step]
        moved = [pose for pose in before if pose is not None]
        return replace(self.start, world_from_object=moved[-1]) if moved else self.start

    def sensor_images(self, steps: Sequence[int] | None = None) -> Iterator[SensorImage]:
        """Yield the images of some steps (None: of all) in their order, read one at a time."""
        for step in steps or ():
            self._check_step(step, self.image_steps, what="image of a sensor")
        return self._images(steps)

    def problem(self, step: int) -> RegistrationProblem:
        """Return the registration problem of a step, from the file alone; its digest is checked."""
        self._check_step(step, self.steps, what="registration problem")
        entry, points = self._found(RecordedProblem, step)
        return self._completed(entry, points)

    def decision(self, step: int) -> Decided:
        """Return the decision that follows a step, with its problem, whose digest is checked."""
        self._check_step(step, self.decision_steps, what="decision")
        entry, points = self._found(RecordedDecision, step)
        before = self._entries[: self._entries.index(entry)]
        offered = [each for each in before if isinstance(each, ActionsOffered)]
        return self._decided(entry, offered[-1], points=points)

    def checked_steps(self, steps: Sequence[int] | None) -> tuple[int, ...]:
        """Return steps with a problem, in order; None: all. Raise RecordingError for others."""
        if steps is None:
            return self.steps
        wanted = set(steps)
        known = set(self.steps)
        for step in sorted(wanted - known):
            self._check_step(step, self.steps, what="registration problem")
        return tuple(step for step in self.steps if step in wanted)

    def hypotheses(self, step: int) -> Hypotheses:
        """Return the hypotheses of the registration of a step."""
        if step not in self._results:
            self._check_step(step, tuple(self._results), what="result")
        return self._results[step]

    def has_result(self, step: int) -> bool:
        """Return whether the registration of a step ended with hypotheses."""
        return step in self._results

    @property
    def seed(self) -> int:
        """Seed of the random streams of registrations; without any that of the session."""
        seeds = (entry.seed for entry in self._entries if isinstance(entry, RecordedProblem))
        return next(seeds, self.start.seed)

    @cached_property
    def digest(self) -> str:
        """The digest of its file, which names the recording."""
        return file_digest(self.path)

    def snapshots(self, step: int) -> list[ArchiveSnapshot]:
        """Return the archive over the registration of a step; empty if the method keeps none."""
        return list(self._snapshots.get(step, []))

    @cached_property
    def _results(self) -> dict[int, Hypotheses]:
        """Hypotheses by step."""
        return {e.step: e.hypotheses for e in self._entries if isinstance(e, HypothesesFound)}

    @cached_property
    def _snapshots(self) -> dict[int, list[ArchiveSnapshot]]:
        """Archives by step."""
        taken: dict[int, list[ArchiveSnapshot]] = {}
        for entry in self._entries:
            if isinstance(entry, SnapshotTaken):
                taken.setdefault(entry.step, []).append(entry.archive)
        return taken

    def _images(self, steps: Sequence[int] | None = None) -> Iterator[SensorImage]:
        """Yield the images in the file; other messages are passed by."""
        topic = "/sensor_image"
        schemas = {topic: TOPIC_SCHEMAS[topic]}
        file = McapFile(self.path, schemas, partial=self.damage is not None)
        for message in file.messages():
            if steps is None or message.log_time // STEP_TIME - 1 in steps:
                with _blaming(self.path):
                    found = image_from(decode(RECORDS[topic], message.data))
                yield found

    def _next(self, seen: Iterator[SensorImage], place: ImagePlace) -> SensorImage:
        """Return the image at a place; raise RecordingError if the file has changed."""
        found = next(seen, None)
        if found is None or found.step != place.step:
            raise RecordingError(f"recording {self.path} has changed while it was read")
        return found

    def _found(self, kind: type[Placed], step: int) -> tuple[Placed, KnownPoints]:
        """Return an entry of a step that is there, and all points before it."""
        points = self.start.initial_points
        for entry in self._entries:
            if isinstance(entry, Probe):
                points = entry.added_to(points)
            if isinstance(entry, kind) and entry.step == step:
                break
        assert isinstance(entry, kind)
        return entry, points

    def _decided(
        self, entry: RecordedDecision, offered: ActionsOffered | None, *, points: KnownPoints
    ) -> Decided:
        assert offered is not None  # as the decision was read
        with _blaming(self.path):
            return entry.completed(self.start, offered, points=points)

    def _completed(self, entry: RecordedProblem, points: KnownPoints) -> RegistrationProblem:
        with _blaming(self.path):
            return entry.completed(self.start.sdf, points)

    def _check_step(self, step: int, accepted: tuple[int, ...], *, what: str) -> None:
        if step not in accepted:
            steps = ", ".join(map(str, accepted)) or "none"
            raise RecordingError(
                f"recording {self.path} has no {what} of step {step}; accepted: {steps}"
            )


def read_recording(path: str | Path, *, partial: bool = False) -> Recording:
    """Read a recording, every checksum and digest checked.

    With `partial`, an unfinished or damaged file gives all events before the first damage, which
    `Recording.damage` names. Raise RecordingError if the file does not exist, is no recording of
    this project, is of another format, or is unfinished or damaged.
    """
    path = Path(path).expanduser()
    file = McapFile(path, TOPIC_SCHEMAS, partial=partial)
    reader = EventReader(file.attachments)
    entries = list[Entry]()
    for message in file.messages():
        with _blaming(path):
            entry = reader.take(message)
        if entry is not None:
            entries.append(entry)
    if reader.within is not None and file.damage is None:
        raise DamagedRecordingError(path, f"ends within an event on {reader.within}")
    sizes = {name: len(data) for name, data in file.attachments.items()}
    return Recording(path, entries, damage=file.damage, attachments=sizes)


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Name the file in whatever is wrong with its content."""
    try:
        yield
    except (ChselError, ValueError, RecursionError, OverflowError, MemoryError) as error:
        raise RecordingError(f"recording {path}: {one_line(str(error))}") from error
