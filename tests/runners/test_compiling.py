"""Kernels are compiled before the first probe, and none later."""

import os
import re
import subprocess
import sys

import pytest

from chsel.problem.poses import apply
from tests.chsel.samples import REPOSITORY
from tests.runners.box_session import POSE, points_session

SESSION = """
import sys
import chsel.session.judging
from numba.core.dispatcher import Dispatcher
from runners import probe

def specialised():
    kernels = [module for name, module in sys.modules.items() if name.startswith("chsel.")]
    return {
        (kernel.__name__, str(signature))
        for module in kernels
        for kernel in vars(module).values()
        if isinstance(kernel, Dispatcher) and type(kernel._cache).__name__ != "NullCache"
        for signature in kernel.nopython_signatures
    }

def noting(*given, **named):
    compiled.update(specialised())
    return run(*given, **named)

class Always(str):  # as if every verdict needed rivals
    __eq__ = lambda self, other: True

chsel.session.judging.DETERMINED = Always()
compiled, run, probe.run_session = set(), probe.run_session, noting
probe.main()
print("compiled", len(compiled), "more", sorted(specialised() - compiled))
"""
QUICK = ("method.descent.restarts=1", "method.descent.iterations=5", "method.emitter.iterations=2")


@pytest.mark.parametrize(
    "choice",
    [("method=chsel", *QUICK), ("method=cvo", "preset=reference"), ("method=anchored",)],
    ids=lambda choice: choice[0],
)
def test_a_session_needs_no_kernel_that_is_not_there_before_its_first_probe(choice, tmp_path):
    felt = {"known": apply(POSE, [[0.0, 0.0, 0.11]]), "known_sdf": [0.01], "known_step": [2]}
    occupied = {"occupied": POSE[None, :3, 3], "occupied_step": [1]}
    points = points_session(tmp_path, 3, **felt, **occupied)
    command = [sys.executable, "-c", SESSION, *points, *choice, f"logs={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    before, more = re.findall(r"compiled (\d+) more (.*)", done.stdout)[0]
    assert int(before) > 5
    assert more == "[]"
