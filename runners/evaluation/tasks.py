"""One task of an evaluation: what a worker gets, does in a folder of its own, and gives back.

No folder is shared between workers and the process that waits for them: all files of a task travel
with it. Only raw logs of robots and the scans of objects are read where they are.
"""

from __future__ import annotations

import errno
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from replay.environment import environment
from replay.files import whole_file
from runners.evaluation.external_results import ExternalResults, external_rows
from runners.evaluation.plan import Plan, Task
from runners.evaluation.run_method import run_method
from runners.evaluation.run_policy import run_policy
from runners.evaluation.trial_session import SESSION_FILES, make_session
from runners.run.session_run import one_line

Files = Mapping[str, bytes]
"""Contents by path in the folder of an evaluation."""
LOGS = "logs/"
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO)


@dataclass(frozen=True)
class Outcome:
    """How a task ended."""

    files: Files = field(default_factory=dict)  # made by it
    seconds: float = 0.0
    failure: str = ""  # why there are none
    stops: bool = False  # whether all other tasks would fail likewise, as on a full disk
    environment: Mapping[str, str] = field(default_factory=dict)  # of the worker


def input_files(plan: Plan, task: Task) -> dict[str, bytes]:
    """What a task reads: a session what there is of it already, a method finished sessions."""
    trials = task.sessions(plan) if task.label else (task.trial,)
    paths = [
        path
        for trial in trials
        for pattern in SESSION_FILES
        for path in trial.folder(plan).glob(pattern)
        if not path.name.startswith(".")
    ]
    files = {str(path.relative_to(plan.folder)): path.read_bytes() for path in paths}
    if not task.label and plan.is_simulated_log(task.trial):
        folder = plan.log_folder / task.trial.configuration
        for path in folder.glob(f"seed_{task.trial.seed}.*"):
            files[f"{LOGS}{path.relative_to(plan.log_folder)}"] = path.read_bytes()
    return files


def store_files(plan: Plan, task: Task, files: Files) -> None:
    """Write what a task has made, each file whole or not at all; last the one that finishes it."""
    last = str(task.finished(plan).relative_to(plan.folder))
    for name in sorted(files, key=lambda name: (name == last, name)):
        path = plan.folder / name
        if name.startswith(LOGS):
            path = plan.log_folder / name.removeprefix(LOGS)
        with whole_file(path) as beside:
            beside.write_bytes(files[name])


def run_task(
    plan: Plan,
    task: Task,
    files: Files,
    external: ExternalResults | None = None,
    *,
    warm: set[str] | None = None,
    scratch: str | None = None,
) -> Outcome:
    """Do a task in a new folder within `scratch`; a failure is an outcome, too.

    external: what is to be ranked, in place of a method's results. warm: labels that have been at
    work in this process before.
    """
    known = set() if warm is None else warm
    begun = time.perf_counter()
    with TemporaryDirectory(dir=scratch, prefix="task-") as name:
        folder = Path(name)
        here = plan.moved(folder, task.trial)
        try:
            for path, content in files.items():
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                (folder / path).write_bytes(content)
            task.trial.folder(here).mkdir(parents=True, exist_ok=True)
            if not task.label:
                make_session(here, task.trial)
            elif external is not None:
                external_rows(here, task.trial, task.label, external)
            elif plan.policies:
                run_policy(here, task.trial, plan.policies[task.label], known)
            else:
                run_method(here, task.trial, plan.contenders[task.label], known)
            made = _made(folder, files)
        except Exception as error:
            reason = one_line(error).replace(name, str(plan.folder))
            return Outcome(failure=reason, stops=_is_disk_error(error))
    return Outcome(made, time.perf_counter() - begun, environment=_environment())


def run_on_worker(
    plan: Plan, task: Task, files: Files, external: ExternalResults | None
) -> Outcome:
    """`run_task` on a worker of Dask, on one thread, in the worker's own folder."""
    from distributed import get_worker

    torch.set_num_threads(1)
    worker: Any = get_worker()
    warm = vars(worker).setdefault("warm_methods", set())
    return run_task(plan, task, files, external, warm=warm, scratch=worker.local_directory)


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the process that waits; Dask calls this in every worker that preloads it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _made(folder: Path, given: Files) -> dict[str, bytes]:
    paths = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in paths.items() if name not in given}


def _is_disk_error(error: BaseException | None) -> bool:
    """Whether an error, or one behind it, is that a disk is full or cannot be written."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False


@cache
def _environment() -> Mapping[str, str]:
    return environment()
