"""The tasks of an evaluation: sessions and what is registered on them, each done by some worker."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING

from chsel.errors import ChselError, RecordingError
from chsel.numerics.threads import threads
from replay.environment import environment
from runners.evaluation.external_results import external_digest, external_rows
from runners.evaluation.plan import Plan, Task, Trial
from runners.evaluation.run_method import run_method
from runners.evaluation.run_policy import run_policy
from runners.evaluation.table import Row, part_source, write_part
from runners.evaluation.trial_session import make_session, read_session
from runners.run.session_run import one_line

if TYPE_CHECKING:
    from distributed import Client, Future


@dataclass(frozen=True)
class Ended:
    """A task that is done, or has failed."""

    task: Task
    failure: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)  # of its worker


def tasks_of(plan: Plan, trials: Sequence[Trial]) -> list[Task]:
    """All tasks of trials, seed by seed, those without a label, which others need, first."""
    labelled = [Task(trial, label) for trial in trials for label in plan.labels]
    sessions = [Task(session) for task in labelled for session in task.sessions(plan)]
    return sorted(
        {*sessions, *labelled}, key=lambda task: (task.trial.seed, bool(task.label), task)
    )


def is_finished(plan: Plan, task: Task) -> bool:
    """Whether the task's last file is there and whole. External results may have changed since."""
    if not task.label:
        return has_session(plan, task.trial)
    source = part_source(task.finished(plan))
    if task.label in plan.outside:
        return source == external_digest(plan, task.trial, task.label)
    return source is not None


def has_session(plan: Plan, trial: Trial) -> bool:
    """Whether `make_session` has finished with a trial."""
    try:
        read_session(plan, trial)
    except (OSError, RecordingError):
        return False
    return True


def do_task(plan: Plan, task: Task, needed: Sequence[object] = ()) -> Mapping[str, str]:
    """Do a task, on one thread: its files are in the plan's folder when it ends.

    Gives the environment. needed: what tasks gave that must have ended before.
    """
    task.trial.folder(plan).mkdir(parents=True, exist_ok=True)
    with threads(1):
        if not task.label:
            make_session(plan, task.trial)
        elif task.label in plan.outside:
            external_rows(plan, task.trial, task.label)
        elif plan.policies:
            run_policy(plan, task.trial, plan.policies[task.label])
        else:
            run_method(plan, task.trial, plan.contenders[task.label])
    if task.label:
        task.failed(plan).unlink(missing_ok=True)
    return environment()


def do_tasks(plan: Plan, tasks: Sequence[Task], client: Client, workers: int) -> Iterator[Ended]:
    """Do tasks on Dask's workers, in this order; yields each when it has ended.

    A failure becomes part of the table; the next call tries again. There are no more tasks under
    way than workers, so that none ends with a worker that another one kills.
    """
    from distributed import wait

    waiting = iter(tasks)
    running: dict[Future, Task] = {}
    sessions: dict[Trial, Future] = {}
    failed: set[Trial] = set()
    while True:
        for task in islice(waiting, workers - len(running)):
            needed = [sessions[trial] for trial in task.sessions(plan) if trial in sessions]
            future = client.submit(do_task, plan, task, needed, key=None, pure=False)
            running[future] = task
            if not task.label:
                sessions[task.trial] = future
        if not running:
            return
        for future in wait(list(running), return_when="FIRST_COMPLETED").done:
            task = running.pop(future)
            failure = _failure(future)
            if failure and not task.label:
                failed.add(task.trial)
            elif failure:
                of_session = not failed.isdisjoint(task.sessions(plan))
                failure = f"session: {failure}" if of_session else failure
                write_part(task.failed(plan), _failure_rows(plan, task, failure), plan.schema)
            yield Ended(task, failure, {} if failure else future.result())


def _failure(future: Future) -> str:
    """Why a task has no result. Raises ChselError if that says nothing about the task."""
    from distributed import KilledWorker

    if future.cancelled():
        raise ChselError("Dask's scheduler is gone; the same command goes on with another one")
    error = future.exception()
    if isinstance(error, KilledWorker):
        times = error.allowed_failures + 1
        return f"its worker died {times} times, as of a lack of memory"
    return "" if error is None else one_line(error)


def _failure_rows(plan: Plan, task: Task, reason: str) -> list[Row]:
    """A row a step, or one without a step if there is no session that has the steps."""
    about = {**plan.about(task.trial, task.label), "status": f"failed: {reason}"}
    if plan.policies or not has_session(plan, task.trial):
        return [about]
    return [{**about, "step": step} for step in read_session(plan, task.trial).steps]


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the process that waits; Dask calls this in every worker that preloads it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
