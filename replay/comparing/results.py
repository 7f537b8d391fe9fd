"""The results of a recorded registration beside those of the same one, registered again."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import (
    VERDICTS,
    ArchiveSnapshot,
    Hypotheses,
    RegistrationProblem,
    Trust,
)
from replay.comparing.differences import differences
from replay.events import (
    Event,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    SnapshotTaken,
    Traced,
)
from replay.mcap.reader import Recording
from replay.mcap.recovery import tells_loss

RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""How far a measured number may be from the recorded one: libraries may round otherwise."""

ERRORS = 1e-4
"""m or rad: how far errors to the true pose may be, as symmetries depend on LAPACK and libigl."""

_TRUST = Trust(0.0, 0.0, 0.0, 1, 0.0, VERDICTS[0], 0).numbers.keys()
_HYPOTHESES = ("object_from_world", "cost", "duplicate", "cell", "elites")


@dataclass(frozen=True, eq=False)
class RecordedRegistration:
    """A recorded problem with the events up to the next one."""

    posed: ProblemPosed
    new_points: KnownPoints  # since the problem before
    follows: bool  # whether E_0 and E_l are of results in this recording, none of them lost
    following: list[Event]  # also those of other steps
    preceding: list[Event]  # since the problem before
    is_first: bool  # whether there is no problem before

    @property
    def last_result(self) -> Hypotheses | None:
        """The result that is known when the next problem is posed."""
        return result_in(self.following[::-1])

    @property
    def complete(self) -> bool:
        """Whether no event of the registration may be lost."""
        for event in self.following:
            if isinstance(event, HypothesesFound) and event.step == self.posed.step:
                return True
            if tells_loss(event):
                return False
        return True

    @property
    def events(self) -> list[Event]:
        """The events of the registration; its result alone if some may be lost."""
        own = [e for e in self.following if getattr(e, "step", None) == self.posed.step]
        return own if self.complete else [e for e in own if isinstance(e, HypothesesFound)]


def recorded_registrations(recording: Recording) -> Iterator[RecordedRegistration]:
    """The registrations of a recording, in their order."""
    events = recording.events(images=False)
    before, posed = _until_next_problem(events)
    lost, first = False, True
    while posed is not None:
        for event in before:
            lost = tells_loss(event) or (lost and not isinstance(event, HypothesesFound))
        new = [event.new_points for event in before if isinstance(event, Probe)]
        following, next_posed = _until_next_problem(events)
        follows = not recording.start.source and not lost
        points = KnownPoints.joined([KnownPoints(), *new])
        yield RecordedRegistration(posed, points, follows, following, before, first)
        before, posed, first = following, next_posed, False


def _until_next_problem(events: Iterator[Event]) -> tuple[list[Event], ProblemPosed | None]:
    before: list[Event] = []
    for event in events:
        if isinstance(event, ProblemPosed):
            return before, event
        before.append(event)
    return before, None


def result_in(events: Sequence[Event]) -> Hypotheses | None:
    """The first result among events."""
    return next((e.hypotheses for e in events if isinstance(e, HypothesesFound)), None)


def stage_name(event: Traced | SnapshotTaken) -> str:
    """How a report names the moment of a trace or a snapshot of the archive."""
    if isinstance(event, Traced):
        return f"{event.stage}, iteration {event.iteration}"
    return f"archive, iteration {event.archive.iteration}"


@dataclass
class ResultDifferences:
    """Collects what differs between two registrations, stage by stage."""

    stage: str = ""  # the first that differs; empty if none does
    before: int = 0  # how many stages before it are equal
    lines: list[str] = field(default_factory=list)
    largest_ulps: int = 0  # over all numbers compared

    def add_stage(self, name: str, *, equal: bool) -> None:
        """The next stage is compared."""
        if not self.stage:
            self.before += equal
            self.stage = "" if equal else name

    def add(
        self, stage: str, first: Mapping[str, Any], second: Mapping[str, Any], *, show: bool = True
    ) -> None:
        """The values of the next stage are compared. show: whether lines name those that differ."""
        found = differences(first, second)
        self.add_stage(stage, equal=not found)
        if show:
            self.lines += [item.text for item in found]
            self.largest_ulps = max([self.largest_ulps, *(item.ulps or 0 for item in found)])

    def fail(self, stage: str, reason: str) -> None:
        """A stage cannot be compared."""
        self.add_stage(stage, equal=False)
        self.lines.append(reason)

    def add_sets(self, recorded: RegistrationProblem, again: RegistrationProblem) -> None:
        """E_0 and E_l (CHSEL, Alg. 2)."""
        self.add("making E_0", {"E_0": recorded.initial_set}, {"E_0": again.initial_set})
        self.add("making E_l", {"E_l": recorded.low_cost_set}, {"E_l": again.low_cost_set})

    def add_stages(self, recorded: Sequence[Event], again: Sequence[Event]) -> None:
        """Traces and snapshots in the order in which they were recorded, then the hypotheses.

        Without a result, what a registration did not come to is not compared.
        """
        expected, found = result_in(recorded), result_in(again)
        others = _by_stage(again)
        for name, event in _by_stage(recorded).items():
            other = others.get(name)
            if other is None and found is not None:
                self.add_stage(f"{name}, which does not come about", equal=False)
            elif isinstance(event, Traced):
                self.add_stage(name, equal=event == other)
            elif isinstance(event, SnapshotTaken) and isinstance(other, SnapshotTaken):
                pair = (_archive(name, event.archive), _archive(name, other.archive))
                self.add(name, *pair, show=not self.stage)
        if expected is not None and found is not None:
            self._add_hypotheses(expected, found)

    def _add_hypotheses(self, recorded: Hypotheses, again: Hypotheses) -> None:
        one, other = ({name: getattr(h, name) for name in _HYPOTHESES} for h in (recorded, again))
        self.add("choosing the hypotheses", one, other)
        archives = (recorded.archive, again.archive)
        if any(archives):
            one, other = ({} if a is None else _archive("last archive", a) for a in archives)
            self.add("the last archive", one, other)

    def add_measured(self, recorded: Sequence[Event], again: Sequence[Event]) -> None:
        """The numbers about the result, within tolerances.

        Errors that were not recorded are not compared.
        """
        values = [event.values for event in recorded if isinstance(event, Measured)]
        computed = next((event.values for event in again if isinstance(event, Measured)), None)
        if len(values) != 1:
            reason = f"there are {len(values)} messages of measured values; accepted: one"
            self.fail("the measured values", reason)
        elif computed is not None:
            names = {*values[0], *computed}
            if not names.intersection(_TRUST, values[0]):
                names -= _TRUST
            errors = {name for name in names if name.endswith("_error")}
            if not errors.intersection(values[0]):
                names -= errors  # which are modulo the shape's symmetries
            far = [
                name
                for name in sorted(names)
                if not is_close(values[0].get(name), computed.get(name), name)
            ]
            pair = ({f"measured {n}": v[n] for n in far if n in v} for v in (values[0], computed))
            self.add("the measured values", *pair)


def has_measured(registration: RecordedRegistration) -> bool:
    """Whether a recording should have the numbers that today's code computes."""
    numbers = any(isinstance(event, Measured) for event in registration.events)
    return numbers or not any(map(tells_loss, registration.following))


def is_close(recorded: float | None, computed: float | None, name: str) -> bool:
    """Whether a measured number is the recorded one, within its tolerance."""
    if recorded is None or computed is None:
        return False
    if math.isnan(recorded) or math.isnan(computed):
        return math.isnan(recorded) and math.isnan(computed)
    absolute = ERRORS if name.endswith("_error") else ABSOLUTE
    return math.isclose(recorded, computed, rel_tol=RELATIVE, abs_tol=absolute)


def _by_stage(events: Sequence[Event]) -> dict[str, Traced | SnapshotTaken]:
    """Traces and snapshots by a name; those of later passes are numbered."""
    named: dict[str, Traced | SnapshotTaken] = {}
    for event in events:
        if isinstance(event, Traced | SnapshotTaken):
            name, number = stage_name(event), 1
            while name in named:
                number += 1
                name = f"{stage_name(event)} (pass {number})"
            named[name] = event
    return named


def _archive(name: str, archive: ArchiveSnapshot) -> dict[str, Any]:
    """All of a snapshot, range and names included."""
    return {f"{name}: {part.name}": getattr(archive, part.name) for part in fields(archive)}
