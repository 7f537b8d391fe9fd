"""Which unit is done when, and what becomes of one that fails."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from chsel.errors import ChselError
from runners.evaluation.external_results import PRESET
from runners.evaluation.plan import Plan, Task, Trial
from runners.evaluation.pool import Died, Job, Pool
from runners.evaluation.table import RESULTS, Row, write_part
from runners.evaluation.trial_session import has_session, read_session
from runners.evaluation.work import Outcome, is_finished, work

ATTEMPTS = 2  # of a unit whose worker dies
_TICK = 1.0  # s: how long is waited before what is shown is renewed
_ELSEWHERE = 5.0  # s: after which is looked again for a unit that another run does


@dataclass
class Progress:
    """How far a schedule is. finished: before it began. failed: reasons by unit."""

    total: int
    finished: int = 0
    done: int = 0
    running: list[Task] = field(default_factory=list)
    failed: dict[Task, str] = field(default_factory=dict)
    seconds_left: float | None = None


def units_of(plan: Plan, trials: Sequence[Trial]) -> list[Task]:
    """All units of trials; a session and its methods need no order here."""
    labels = ["", *plan.contenders, *plan.outside]
    return [Task(trial, label) for trial in trials for label in labels]


class Schedule:
    """Does units seed by seed, the longest first; a session goes before its methods."""

    def __init__(
        self,
        plan: Plan,
        trials: Sequence[Trial],
        workers: int,
        show: Callable[[Progress], None],
        job: Job = work,
    ) -> None:
        units = units_of(plan, trials)
        self._plan, self._workers, self._show = plan, workers, show
        self._pool = Pool(plan, workers, job)
        self._open = {unit for unit in units if not is_finished(plan, unit)}
        self._not_before: dict[Task, float] = {}
        self._attempts: dict[Task, int] = {}
        self._speed = _Speed(plan)
        self.progress = Progress(len(units), len(units) - len(self._open))

    def run(self) -> Progress:
        """Do all units. Raises ChselError for a failure that all would share, such as a full disk;
        what is finished by then stays so, as it does when this process is interrupted or killed.
        """
        try:
            while self._open or self._pool.running:
                while self._pool.free and (unit := self._next()) is not None:
                    self._open.discard(unit)
                    if is_finished(self._plan, unit):  # by another run
                        self.progress.done += 1
                    else:
                        self._pool.give(unit)
                self._tell()
                if not self._pool.running:
                    time.sleep(_TICK)
                for unit, outcome in self._pool.ended(_TICK):
                    self._take(unit, outcome)
        finally:
            self._pool.close()
        self._tell()
        return self.progress

    def _next(self) -> Task | None:
        """The unit to begin; None if none can be begun yet."""
        now = time.monotonic()
        ready = [unit for unit in self._open if self._not_before.get(unit, 0.0) <= now]
        ready = [unit for unit in ready if not unit.label or self._has_session(unit.trial)]
        return min(ready, key=self._order, default=None)

    def _order(self, unit: Task) -> tuple[int, bool, float, Task]:
        return unit.trial.seed, bool(unit.label), -self._speed.expected(unit), unit

    def _has_session(self, trial: Trial) -> bool:
        return Task(trial) not in self._open and has_session(self._plan, trial)

    def _take(self, unit: Task, outcome: Outcome | Died) -> None:
        if isinstance(outcome, Died):
            self._attempts[unit] = self._attempts.get(unit, 0) + 1
            if self._attempts[unit] < ATTEMPTS:
                self._open.add(unit)
            else:
                self._fail(unit, f"its process died {ATTEMPTS} times, {_ending(outcome.code)}")
        elif outcome.kind == "elsewhere":
            self._not_before[unit] = time.monotonic() + _ELSEWHERE
            self._open.add(unit)
        elif outcome.kind == "stop":
            raise ChselError(outcome.reason)
        elif outcome.kind == "failed":
            self._fail(unit, outcome.reason)
        else:
            self.progress.done += 1
            self._speed.take(unit, outcome.seconds)

    def _fail(self, unit: Task, reason: str) -> None:
        """Put the failure into the table; the next call tries again."""
        self.progress.failed[unit] = reason
        if unit.label:
            write_part(unit.failed(self._plan), self._failure_rows(unit, reason), RESULTS)
            return
        for other in [other for other in self._open if other.trial == unit.trial]:
            self._open.discard(other)
            self._fail(other, f"session: {reason}")

    def _failure_rows(self, unit: Task, reason: str) -> list[Row]:
        """A row a step, or one without a step if there is no session that tells the steps."""
        plan, trial = self._plan, unit.trial
        preset = PRESET if unit.label in plan.outside else plan.contenders[unit.label].preset
        steps: Sequence[int | None] = (None,)
        if has_session(plan, trial):
            steps = read_session(plan, trial).steps
        return [
            {
                "object": plan.configurations[trial.configuration].object,
                "configuration": trial.configuration,
                "seed": trial.seed,
                "method": unit.label,
                "preset": preset,
                "definition": plan.definition_label,
                "faults": plan.faults(trial),
                "step": step,
                "status": f"failed: {reason}",
            }
            for step in steps
        ]

    def _tell(self) -> None:
        left = sum(self._speed.expected(unit) for unit in self._open)
        left += sum(self._speed.expected(unit) for unit in self._pool.running) / 2.0
        known = self._speed.known
        self.progress.running = self._pool.running
        self.progress.seconds_left = left / self._workers if known else None
        self._show(self.progress)


class _Speed:
    """How long units take, from those that are done: by label, for every probe."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._seconds: dict[str, float] = {}
        self._probes: dict[str, int] = {}

    @property
    def known(self) -> bool:
        """Whether any unit is done."""
        return bool(self._probes)

    def take(self, unit: Task, seconds: float) -> None:
        """A unit is done."""
        label = unit.label
        self._seconds[label] = self._seconds.get(label, 0.0) + seconds
        self._probes[label] = self._probes.get(label, 0) + self._probes_of(unit)

    def expected(self, unit: Task) -> float:
        """Seconds that a unit will take; of an unknown label, as the mean of all."""
        if unit.label in self._probes:
            return self._probes_of(unit) * self._seconds[unit.label] / self._probes[unit.label]
        probes = sum(self._probes.values())
        return self._probes_of(unit) * (sum(self._seconds.values()) / probes if probes else 1.0)

    def _probes_of(self, unit: Task) -> int:
        return self._plan.configurations[unit.trial.configuration].probes or 1


def _ending(code: int | None) -> str:
    """How a process ended, for people."""
    if code is None or code >= 0:
        return f"exit status {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"{name}, as of a lack of memory" if name == "SIGKILL" else name
