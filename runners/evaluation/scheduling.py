"""Which task runs next, and what becomes of one that fails or whose worker dies."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from chsel.errors import ChselError
from runners.evaluation.cluster import Connection
from runners.evaluation.external_results import PRESET, external_digest, read_external
from runners.evaluation.plan import Plan, Task, Trial
from runners.evaluation.probe_rows import row_about
from runners.evaluation.progress_display import Progress
from runners.evaluation.table import Row, is_part, part_source, write_part
from runners.evaluation.tasks import Outcome, input_files, run_on_worker, store_files
from runners.evaluation.trial_session import has_session, read_session
from runners.run.probe_run import Interrupt
from runners.run.session_run import one_line

_TICK = 1.0  # s: how long is waited before what is shown is renewed


def tasks_of(plan: Plan, trials: Sequence[Trial]) -> list[Task]:
    """All tasks of trials: their sessions, those without faults that they need, and all labels."""
    methods = [Task(trial, label) for trial in trials for label in plan.labels]
    sessions = [Task(session) for trial in trials for session in Task(trial).sessions(plan)]
    return [*dict.fromkeys(sessions), *methods]


def is_finished(plan: Plan, task: Task) -> bool:
    """Whether there is nothing left to do. External results may have changed since.

    A file that is damaged, as by a power cut, is made again.
    """
    if not task.label:
        return has_session(plan, task.trial)
    finished = task.finished(plan)
    if not is_part(finished):
        return False
    if task.label in plan.outside:
        return part_source(finished) == external_digest(plan, task.trial, task.label)
    return True


class Scheduling:
    """Does tasks seed by seed, sessions first and then the longest; every result is stored at once.

    A worker has one task at a time and gets the next when the last one is here, so that no result
    is lost with a worker, and a worker that dies costs no other task than the one it did.
    """

    def __init__(
        self, plan: Plan, trials: Sequence[Trial], show: Callable[[Progress], None]
    ) -> None:
        tasks = tasks_of(plan, trials)
        self._plan, self._show = plan, show
        self._open = {task for task in tasks if not is_finished(plan, task)}
        self._without_session = {task.trial for task in self._open if not task.label}
        self._running: dict[Any, Task] = {}  # by Dask's future
        self._durations = _Durations(plan)
        self._workers = 0
        self.progress = Progress(len(tasks), len(tasks) - len(self._open))
        self.environments: list[dict[str, str]] = []  # of the workers

    def run(self, cluster: Connection) -> None:
        """Do all tasks on a cluster.

        Raises ChselError for a failure that all would share, such as a full disk. What is finished
        by then stays so, as it does when this process is interrupted or killed.
        """
        client = cluster.client
        with Interrupt() as interrupt, client.as_current():
            while self._open or self._running:
                self._submit(client)
                outcomes = self._ended()
                self._submit(client)  # before files are written: workers need not wait for that
                for task, outcome in outcomes:
                    self._take(task, outcome)
                cluster.restore()
                self._report()
                interrupt.check()

    def _submit(self, client: Any) -> None:
        """Give a task to every worker without one."""
        threads = client.nthreads()
        if any(number > 1 for number in threads.values()):
            raise ChselError(
                f"a worker has {max(threads.values())} threads; accepted: one, as of `dask worker "
                "--nthreads 1 --nworkers NUMBER`"
            )
        self._workers = len(threads)
        while len(self._running) < self._workers and (task := self._next()) is not None:
            self._open.discard(task)
            try:
                self._running[self._submitted(client, task)] = task
            except (ChselError, OSError) as error:  # of its files here
                self._fail(task, one_line(error))

    def _submitted(self, client: Any, task: Task) -> Any:
        """The future of a task."""
        external = None
        if task.label in self._plan.outside:
            external = read_external(self._plan, task.trial, task.label)
        files = input_files(self._plan, task)
        plan = self._plan.moved(self._plan.folder, task.trial)
        return client.submit(run_on_worker, plan, task, files, external, key=None, pure=False)

    def _next(self) -> Task | None:
        """The task to begin; None if none can be begun yet."""
        ready = [
            task
            for task in self._open
            if not task.label or self._without_session.isdisjoint(task.sessions(self._plan))
        ]
        return min(ready, key=self._order, default=None)

    def _order(self, task: Task) -> tuple[int, bool, float, Task]:
        return task.trial.seed, bool(task.label), -self._durations.expected(task), task

    def _ended(self) -> list[tuple[Task, Outcome]]:
        """The tasks that have ended, after waiting for any for at most a tick."""
        from distributed import wait

        if not self._running:
            time.sleep(_TICK if self._open and not self._workers else 0.0)
            return []
        try:
            done = wait(list(self._running), timeout=_TICK, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            return []
        return [(self._running.pop(future), _outcome(future)) for future in done]

    def _take(self, task: Task, outcome: Outcome) -> None:
        if outcome.stops:
            raise ChselError(outcome.failure)
        if outcome.failure:
            self._fail(task, outcome.failure)
            return
        store_files(self._plan, task, outcome.files)
        if task.label:
            task.failed(self._plan).unlink(missing_ok=True)
        else:
            self._without_session.discard(task.trial)
        self.progress.done += 1
        self._durations.add(task, outcome.seconds)
        if outcome.environment not in self.environments:
            self.environments.append(dict(outcome.environment))

    def _fail(self, task: Task, reason: str) -> None:
        """Put the failure into the table; the next call tries again."""
        self.progress.failed[task] = reason
        if task.label:
            rows = self._failure_rows(task, reason)
            write_part(task.failed(self._plan), rows, self._plan.schema)
            return
        for other in [one for one in self._open if task.trial in one.sessions(self._plan)]:
            if other.label:
                self._open.discard(other)
                self._fail(other, f"session: {reason}")

    def _failure_rows(self, task: Task, reason: str) -> list[Row]:
        """A row a step, or one without a step if there is no session that has the steps."""
        plan, trial = self._plan, task.trial
        if plan.policies:
            about = row_about(plan, trial, task.label)
            return [{**about, "status": f"failed: {reason}"}]
        preset = PRESET if task.label in plan.outside else plan.contenders[task.label].preset
        steps: Sequence[int | None] = (None,)
        if has_session(plan, trial):
            steps = read_session(plan, trial).steps
        return [
            {
                "object": plan.configurations[trial.configuration].object,
                "configuration": trial.configuration,
                "seed": trial.seed,
                "method": task.label,
                "preset": preset,
                "definition": plan.definition_label,
                "faults": plan.faults(trial),
                "step": step,
                "status": f"failed: {reason}",
            }
            for step in steps
        ]

    def _report(self) -> None:
        running = list(self._running.values())
        left = sum(self._durations.expected(task) for task in self._open)
        left += sum(self._durations.expected(task) for task in running) / 2.0
        self.progress.running = running
        self.progress.waits_for_workers = self._workers == 0
        known = self._durations.known and self._workers
        self.progress.seconds_left = left / self._workers if known else None
        self._show(self.progress)


class _Durations:
    """How long tasks take, from those that are done: by label, for every probe."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._seconds: dict[str, float] = {}
        self._probes: dict[str, int] = {}

    @property
    def known(self) -> bool:
        """Whether any task is done."""
        return bool(self._probes)

    def add(self, task: Task, seconds: float) -> None:
        """A task is done."""
        label = task.label
        self._seconds[label] = self._seconds.get(label, 0.0) + seconds
        self._probes[label] = self._probes.get(label, 0) + self._probes_of(task)

    def expected(self, task: Task) -> float:
        """Seconds that a task will take; of an unknown label, as the mean of all."""
        if task.label in self._probes:
            return self._probes_of(task) * self._seconds[task.label] / self._probes[task.label]
        probes = sum(self._probes.values())
        return self._probes_of(task) * (sum(self._seconds.values()) / probes if probes else 1.0)

    def _probes_of(self, task: Task) -> int:
        return self._plan.configurations[task.trial.configuration].probes or 1


def _outcome(future: Any) -> Outcome:
    """What a task gave back. Raises ChselError if that says nothing about the task."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        times = error.allowed_failures + 1
        return Outcome(failure=f"its worker died {times} times, as of a lack of memory")
    except Exception as error:  # run_on_worker returns those of the task
        raise ChselError(
            f"a worker cannot run the tasks of this evaluation ({one_line(error)}); accepted: "
            "workers with the same version of this package as here, and a scheduler that stays"
        ) from error
