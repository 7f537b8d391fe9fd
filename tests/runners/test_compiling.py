"""All kernels are there before the first probe, and a line says so."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.problem.poses import apply, axis_angle, compose

REPOSITORY = Path(__file__).resolve().parents[2]
POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5)), np.array([0.1, 0.2, 0.3]))
SESSION = """
import sys
import chsel.methods
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

def noting(*given):
    compiled.update(specialised())
    return run(*given)

class Always(str):  # as if every verdict needed rivals
    __eq__ = lambda self, other: True

chsel.methods.DETERMINED = Always()
compiled, run, probe.run = set(), probe.run, noting
probe.main()
print("torch", "torch" in sys.modules)
print("compiled", len(compiled), "more", sorted(specialised() - compiled))
"""
QUICK = ("method.descent.restarts=1", "method.descent.iterations=5", "method.emitter.iterations=2")


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    """A session of three steps on a box, with points of every class."""
    folder = tmp_path_factory.mktemp("points")
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(folder / "box.ply")
    surface = apply(POSE, trimesh.sample.sample_surface(box, 15, seed=0)[0])
    free = np.random.default_rng(0).uniform(0.3, 0.6, (40, 3))
    np.savez(
        folder / "box.npz",
        surface=surface,
        surface_step=np.arange(15) // 5,
        free=free,
        free_step=np.arange(40) % 3,
        occupied=POSE[None, :3, 3],
        occupied_step=[1],
        known=apply(POSE, np.array([[0.0, 0.0, 0.11]])),
        known_sdf=[0.01],
        known_step=[2],
        world_from_object=POSE,
    )
    box_file = f"object.path={folder / 'box.ply'}"
    return "session=points", f"session.path={folder / 'box.npz'}", "object=mesh", box_file


@pytest.mark.parametrize(
    "choice",
    [("method=chsel", *QUICK), ("method=cvo", "preset=reference"), ("method=anchored",)],
    ids=lambda choice: choice[0],
)
def test_a_session_needs_no_kernel_that_is_not_there_before_its_first_probe(
    choice, points, tmp_path
):
    command = [sys.executable, "-c", SESSION, *points, *choice, f"logs={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "torch False" in done.stdout
    before, more = re.findall(r"compiled (\d+) more (.*)", done.stdout)[0]
    assert int(before) > 5
    assert more == "[]"
