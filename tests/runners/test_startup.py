"""Start of all commands: help, imports, Ctrl-C, and another package of our name."""

import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from replay.startup import WRONG_PACKAGE
from replay.verbs import VERBS
from runners import probe, report
from tests.runners.in_process import run

REPOSITORY = Path(__file__).resolve().parents[2]
COMMANDS = ("align", "benchmark", "evaluate", "fetch", "plausible", "probe", "published")
COMMANDS += ("real", "report", "serve", "simulate_rig")
HEAVY = ("torch", "trimesh", "igl", "matplotlib", "pybullet", "networkx")
LISTED = f"""
import atexit, sys
atexit.register(lambda: print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr))
"""
INTERRUPTED = """
import importlib.abc, os, signal, sys, time

class Interrupts(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)  # a KeyboardInterrupt would come here

sys.meta_path.insert(0, Interrupts())
"""


def ran(words, folder, *, code, **changes):
    """`python -m words`, with code that Python runs before anything else."""
    (folder / "sitecustomize.py").write_text(code)
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}", **changes}
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    done = run(importlib.import_module(f"runners.{command}").main, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"python -m runners.{command}" in done.stdout
    assert "== Settings" in done.stdout


def test_help_shows_the_choices_made_and_mistakes_are_errors():
    done = run(probe.main, "object=mustard", "method=icp", "seed=3", "-h")
    for shown in ("name: icp", "name: mustard", "seed: 3", "ycb/drill", "method=anchored|chsel|"):
        assert shown in done.stdout
    done = run(report.main, "colour=red", "--help")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: report has no key 'colour'; accepted: dir, out, ")


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_help_of_replay_waits_for_no_heavy_import(verb, tmp_path):
    done = ran(["replay", *([verb] if verb else []), "--help"], tmp_path, code=LISTED)
    assert (done.returncode, done.stderr) == (0, "[]\n")
    assert "usage: replay" in done.stdout


REGISTERED = """
import sys
import numpy as np
import chsel

nodes = np.indices((9, 9, 9)) * 0.01 - 0.04
radius = np.sqrt((nodes**2).sum(axis=0))
gradients = np.moveaxis(nodes / np.maximum(radius, 1e-9), 0, -1)
ball = chsel.SdfGrid(np.full(3, -0.04), 0.01, radius - 0.025, gradients)
free = 0.02 * np.argwhere(np.ones((6, 6, 6))) - 0.05
free = free[(free**2).sum(axis=1) > 0.035**2]
for method in sys.argv[1:]:
    chsel.register(ball, contacts=0.025 * np.eye(3), free=free, method=method)
print([name for name in sys.argv[0].split() if name in sys.modules])
"""


def test_registrations_import_nothing_that_they_do_not_need():
    unwanted = " ".join(
        (
            *HEAVY,
            "scipy.ndimage",
            "scipy.spatial",
            "scipy.sparse",
            "hydra",
            "rerun",
            "pandas",
            "mcap",
        )
    )
    code = REGISTERED.replace("sys.argv[0]", repr(unwanted))
    command = [sys.executable, "-c", code, "chsel", "anchored", "icp", "svgd", "cvo"]
    command.append("medial_constraint")
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


@pytest.mark.skipif(os.name == "nt", reason="there are no such signals on Windows")
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    ("words", "module"),
    [
        (["runners.probe"], "numba"),
        (["runners.report", "x"], "pyarrow"),
        (["replay", "verify", "x.mcap"], "numba"),
    ],
    ids=str,
)
def test_ctrl_c_during_imports_ends_a_command_quietly(words, module, tmp_path):
    done = ran(words, tmp_path, code=INTERRUPTED.format(module=module))
    assert done.returncode == -signal.SIGINT  # which a shell shows as 130
    assert done.stderr == ""


def test_the_published_package_in_our_place_is_named(tmp_path):
    """As pip leaves it, or as it shadows an editable installation."""
    theirs = tmp_path / "chsel"
    theirs.mkdir()
    (theirs / "__init__.py").write_text("from chsel.wrapper import CHSEL")
    (theirs / "wrapper.py").write_text("import pytorch_kinematics")
    for words in (["runners.probe"], ["runners.report", "--help"], ["replay", "info", "x"]):
        done = ran(words, tmp_path, code="")
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == f"error: {WRONG_PACKAGE.format(theirs)}\n"
