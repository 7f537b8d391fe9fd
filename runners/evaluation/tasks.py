"""The tasks of an evaluation, sessions and what is registered on them, done by Dask's workers."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any

from chsel.errors import ChselError, SettingError
from chsel.numerics.threads import threads
from chsel.session.recording import one_line
from runners.evaluation.experiment import PROBES, RESULTS, part_source, write_part
from runners.evaluation.plan import Plan, Task, Trial
from runners.evaluation.run_method import external_digest, external_rows, method_rows
from runners.evaluation.run_policy import policy_rows
from runners.evaluation.trial_session import make_session, read_told, recording_in

if TYPE_CHECKING:
    from distributed import Client, Future

_PATIENCE = 20.0  # seconds without a result, after which workers are counted
_DASK = {
    "distributed.scheduler.allowed-failures": 1,  # the second worker that a task kills is the last
    "distributed.scheduler.worker-ttl": None,  # a long task may keep a worker from answering
}


@contextmanager
def connected(scheduler: str | None, workers: int | None) -> Iterator[tuple[Client, int]]:
    """Open a client of a Dask cluster, with the number of its workers.

    scheduler: the address of one that runs; None for workers of our own, processes of one thread
    on this machine, that end with the context: so many, or one a core; "slurm" for so many jobs of
    one core, of which all else stands in dask-jobqueue's own configuration.
    """
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster
    from distributed.comm import get_address_host_port

    with dask.config.set(_DASK):
        if scheduler in (None, "slurm"):
            size = workers or (CPU_COUNT if scheduler is None else 1)
            own = (
                _jobs(size)
                if scheduler
                else LocalCluster(
                    n_workers=size,
                    threads_per_worker=1,
                    memory_limit=0,
                    host="127.0.0.1",
                    security=True,  # TLS with keys of this run: others can reach the ports
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0", "dashboard": False},
                    silence_logs=logging.CRITICAL,
                    preload=["runners.evaluation.tasks"],
                    env={"NUMBA_NUM_THREADS": "1"},  # Dask sets those of OpenMP, MKL and OpenBLAS
                )
            )
            with own as cluster, Client(cluster) as client:
                yield client, size
            return
        try:  # Dask's client would try for long, and wait for a minute when it is given up
            socket.create_connection(get_address_host_port(scheduler), timeout=30.0).close()
            client = Client(scheduler, timeout=30.0)
        except (OSError, ValueError) as error:
            raise SettingError(
                f"scheduler is {scheduler} ({' '.join(str(error).split())}); accepted: the "
                "address of a running Dask scheduler, such as tcp://127.0.0.1:8786"
            ) from error
        with client:
            yield client, checked_size(client)


def _jobs(count: int) -> Any:
    """Return a cluster of SLURM with so many jobs; a lost one is replaced."""
    import dask

    try:
        from dask_jobqueue import SLURMCluster
    except ModuleNotFoundError as error:
        needed = "scheduler=slurm needs dask-jobqueue: pip install -e '.[slurm]'"
        raise SettingError(needed) from error
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        memory=dask.config.get("jobqueue.slurm.memory", None) or "4GB",
        job_script_prologue=["export NUMBA_NUM_THREADS=1"],
        worker_extra_args=["--preload", "runners.evaluation.tasks"],
    )
    cluster.adapt(minimum_jobs=count, maximum_jobs=count)
    return cluster


def checked_size(client: Client) -> int:
    """Return the number of workers; raise SettingError if one has several threads."""
    of_workers = client.nthreads().values()
    if max(of_workers, default=1) > 1:
        raise SettingError(
            f"a worker has {max(of_workers)} threads; accepted: one, as of `dask worker "
            "--nthreads 1 --nworkers NUMBER`"
        )
    return max(1, len(of_workers))


def tasks_of(plan: Plan, trials: Sequence[Trial]) -> list[Task]:
    """Return all tasks of trials, seed by seed, those without a label, which others need, first."""
    labelled = [Task(trial, label) for trial in trials for label in plan.labels]
    sessions = {Task(session) for task in labelled for session in task.sessions(plan)}
    return sorted(sessions) + sorted(labelled)


def is_finished(plan: Plan, task: Task) -> bool:
    """Return whether the task's last file is there; external results may have changed since."""
    if task.label in plan.outside:
        digest = external_digest(plan, task.trial, label=task.label)
        return part_source(task.finished(plan)) == digest
    return task.finished(plan).exists()


def do_task(plan: Plan, task: Task) -> None:
    """Do a task, on one thread: its files are in the plan's folder when it ends."""
    folder = task.trial.folder(plan)
    label = task.label
    source = ""
    folder.mkdir(parents=True, exist_ok=True)
    with threads(1):
        if not label:
            make_session(plan, task.trial)
            return
        if label in plan.outside:
            source = external_digest(plan, task.trial, label=label)
            rows = external_rows(plan, task.trial, label=label)
        else:
            contender = {**plan.contenders, **plan.policies}[label]
            rows_of = policy_rows if plan.policies else method_rows
            with recording_in(folder / f"{label}.mcap" if plan.recordings else None) as recorder:
                rows = rows_of(plan, task.trial, contender=contender, recorder=recorder)
    write_part(
        task.finished(plan), rows, schema=PROBES if plan.policies else RESULTS, source=source
    )
    task.failed(plan).unlink(missing_ok=True)


def do_tasks(
    plan: Plan, tasks: Sequence[Task], *, client: Client, workers: int
) -> Iterator[tuple[Task, str]]:
    """Do tasks on Dask's workers, sessions first; yields each when it has ended, with its failure.

    There are no more under way than workers, so that none ends with a worker that another kills.
    """
    from distributed import wait

    failed: dict[Trial, str] = {}  # sessions
    for stage in ([t for t in tasks if not t.label], [t for t in tasks if t.label]):
        reasons = {task: [failed[t] for t in task.sessions(plan) if t in failed] for task in stage}
        for task in [task for task in stage if reasons[task]]:
            yield task, _note(plan, task, failure=f"session: {reasons[task][0]}")
        waiting = iter([task for task in stage if not reasons[task]])
        running: dict[Future, Task] = {}
        while True:
            for task in islice(waiting, workers - len(running)):
                running[client.submit(do_task, plan, task, pure=False)] = task
            if not running:
                break
            while True:
                try:
                    ended = wait(list(running), _PATIENCE, return_when="FIRST_COMPLETED").done
                    break
                except TimeoutError:
                    _replace_workers(client, workers)
            for future in ended:
                task = running.pop(future)
                failure = _failure(future)
                if failure and not task.label:
                    failed[task.trial] = failure
                yield task, _note(plan, task, failure=failure)


def _replace_workers(client: Client, count: int) -> None:
    """Start the workers of this machine anew if none is left: Dask may not replace one that dies.

    Such as one that dies before Dask has noticed that it began.
    """
    from distributed import LocalCluster

    if isinstance(client.cluster, LocalCluster) and not client.nthreads():
        client.cluster.scale(0)
        client.cluster.scale(count)


def _failure(future: Future) -> str:
    """Return why a task has no result; raise ChselError if that says nothing about the task."""
    from distributed import KilledWorker

    if future.cancelled():
        raise ChselError("Dask's scheduler is gone; the same command goes on with another one")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return f"its worker died {error.allowed_failures + 1} times, as of a lack of memory"
    return "" if error is None else one_line(error)


def _note(plan: Plan, task: Task, *, failure: str) -> str:
    """Make a failure a part of the table: a row a step, or one if there is no session's steps."""
    if failure and task.label:
        row = {**plan.about(task.trial, task.label), "status": f"failed: {failure}"}
        notes = task.trial.folder(plan) / "session.json"
        steps = read_told(notes.parent)["steps"] if notes.exists() and not plan.policies else [None]
        rows = [{**row, "step": step} for step in steps]
        write_part(task.failed(plan), rows, schema=PROBES if plan.policies else RESULTS)
    return failure


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the process that waits; Dask calls this in every worker that preloads it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
