"""What a worker process does: one unit after the other, each on its own thread alone."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection

import torch

from replay.files import WritingError
from runners.evaluation.claims import ClaimedError, claimed
from runners.evaluation.external_results import external_digest, external_file, rank_external
from runners.evaluation.plan import Plan, Task
from runners.evaluation.run_method import register_trial
from runners.evaluation.table import about_part, is_part
from runners.evaluation.trial_session import has_session, make_session
from runners.run.session_run import one_line

_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMBA")
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}
"""What the environment must have before a worker imports anything."""


@dataclass(frozen=True)
class Outcome:
    """How a unit ended: "done", "elsewhere" (another run does it), "failed", or "stop", a failure
    that all others would share.
    """

    kind: str
    seconds: float = 0.0
    reason: str = ""


def is_finished(plan: Plan, unit: Task) -> bool:
    """Whether there is nothing left to do. Sets from outside may have changed since.

    A file that is damaged, as by a power cut, is made again.
    """
    if not unit.label:
        return has_session(plan, unit.trial)
    finished = unit.finished(plan)
    if not is_part(finished):
        return False
    if unit.label in plan.outside:
        path = external_file(plan.outside[unit.label], unit.trial)
        return about_part(finished) == external_digest(path)
    return True


def do_unit(plan: Plan, unit: Task, warm: set[str]) -> Outcome:
    """Do a unit, unless it is finished or claimed."""
    begun = time.perf_counter()
    try:
        with claimed(plan.folder, unit.claim) as alone:
            if not is_finished(plan, unit):
                if alone:
                    _clear(plan, unit)
                _do(plan, unit, warm)
            if unit.label:
                unit.failed(plan).unlink(missing_ok=True)
    except ClaimedError:
        return Outcome("elsewhere")
    except WritingError as error:
        return Outcome("stop", reason=one_line(error))
    except Exception as error:
        return Outcome("failed", reason=one_line(error))
    return Outcome("done", time.perf_counter() - begun)


def work(connection: Connection, plan: Plan) -> None:
    """Take units from a connection, and answer with outcomes, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that waits
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    warm: set[str] = set()
    while True:
        try:
            unit = connection.recv()
        except EOFError:
            return
        connection.send(do_unit(plan, unit, warm))


def _do(plan: Plan, unit: Task, warm: set[str]) -> None:
    if not unit.label:
        make_session(plan, unit.trial)
    elif unit.label in plan.outside:
        rank_external(plan, unit.trial, unit.label)
    else:
        register_trial(plan, unit.trial, plan.contenders[unit.label], warm)


def _clear(plan: Plan, unit: Task) -> None:
    """Remove what was half written by a process that is no more."""
    folder = unit.trial.folder(plan)
    for path in folder.glob(f".{unit.label or 'session'}.*"):
        path.unlink(missing_ok=True)
    for path in [] if unit.label else (folder / "plausible").glob(".*"):
        path.unlink(missing_ok=True)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
