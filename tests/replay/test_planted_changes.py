"""A change of the code turns the stored replays red at its stage."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Plant:
    """A line of the code that becomes another, and the stage that `verify` must name first."""

    file: str
    line: str
    planted: str
    recording: str
    stage: str


PLANTS = {
    "the draws of the search": Plant(
        "chsel/qd/emitters.py",
        "self.key.stream(Purpose.EMITTER, self.refinement)",
        "self.key.stream(Purpose.EMITTER, self.refinement + 1)",
        "cracker_box_chsel",
        "cma_mega, iteration 10",
    ),
    "one draw of E_0": Plant(
        "chsel/problem/online_registration.py",
        "shift = settings.translation_noise * normals(stream, (count, 3))",
        "shift = settings.translation_noise * normals(stream, (count, 3))[::-1]",
        "cracker_box_chsel",
        "making E_0",
    ),
    "the range of the archive": Plant(
        "chsel/qd/selection.py",
        "half = settings.range_sigmas * np.maximum(",
        "half = (settings.range_sigmas + 1e-14) * np.maximum(",
        "cracker_box_chsel",
        "archive, iteration 0",
    ),
    "the choice of hypotheses": Plant(
        "chsel/qd/selection.py",
        'order = np.argsort(costs, kind="stable")',
        'order = np.argsort(costs, kind="stable")[1:]',
        "cracker_box_chsel",
        "choosing the hypotheses",
    ),
    "the choice of an action": Plant(
        "chsel/policies/policy.py",
        "chosen = -1 if stop else int(np.argmax(score))",
        "chosen = -1 if stop else int(np.argsort(score)[-2])",
        "box_steered",
        "the choice",
    ),
}

KERNEL = Plant(
    "chsel/cost/pose_lanes.py",
    "value = scale * excess",
    "value = 1.0000000000001 * scale * excess",
    "spam_can_gradient_descent",
    "descent, iteration 0",
)
VERIFY = """
import sys
from importlib.machinery import SourceFileLoader
module, line, planted, recording = sys.argv[1:]

def planting(self, name, imported=SourceFileLoader.get_code):
    if name != module:
        return imported(self, name)
    source = self.get_source(name)
    assert source.count(line) == 1
    return compile(source.replace(line, planted), self.path, "exec")

SourceFileLoader.get_code = planting
from replay.__main__ import main
status = main(["verify", recording])
assert module in sys.modules
sys.exit(status)
"""


def verified_with(plant: Plant) -> subprocess.CompletedProcess[str]:
    """`replay verify` in a process that imports the planted line."""
    module = plant.file.removesuffix(".py").replace("/", ".")
    return run(REPOSITORY, "-c", VERIFY, module, plant.line, plant.planted, path_of(plant))


def run(folder: Path, *words: str, **changes: str) -> subprocess.CompletedProcess[str]:
    """Python in a folder, with the packages there."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(folder), **changes}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True
    )


def path_of(plant: Plant) -> str:
    return str(REPOSITORY / "tests" / "replays" / f"{plant.recording}.mcap")


def assert_differs(done: subprocess.CompletedProcess[str], stage: str) -> None:
    """Every step differs, from that stage on."""
    assert done.returncode == 1, done.stderr
    stages = re.findall(r"first difference: (.*) \(", done.stdout)
    steps = re.findall(r"step -?\d+, \w+: differs", done.stdout)
    assert len(steps) == len(stages) > 0
    assert set(stages) == {stage}, done.stdout


@pytest.mark.parametrize("name", PLANTS)
def test_a_planted_change_is_found_and_its_stage_named(name: str) -> None:
    assert_differs(verified_with(PLANTS[name]), PLANTS[name].stage)


def test_a_change_in_a_kernel_is_compiled_and_found(tmp_path: Path) -> None:
    """In a copy, which has the same kernels as the original before."""
    for package in ("chsel", "replay"):
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=unwanted)
    verify = ("-m", "replay", "verify", path_of(KERNEL))
    same = run(tmp_path, *verify)
    assert (same.returncode, KERNEL.stage in same.stdout) == (0, False), same.stderr
    kernel = tmp_path / KERNEL.file
    assert kernel.read_text().count(KERNEL.line) == 1
    kernel.write_text(kernel.read_text().replace(KERNEL.line, KERNEL.planted))
    done = run(tmp_path, *verify, CHSEL_CACHE_DIR=str(tmp_path / "kept"))
    assert "compiling the kernels" in done.stderr
    assert_differs(done, KERNEL.stage)
