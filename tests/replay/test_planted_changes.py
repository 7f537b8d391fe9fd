"""A change of the code, planted into a copy of it, turns the stored replays red at its stage."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from chsel.numerics.kernel_cache import cache_directory

REPOSITORY = Path(__file__).resolve().parents[2]
REPLAYS = REPOSITORY / "tests" / "replays"


@dataclass(frozen=True)
class Plant:
    """A line of the code that becomes another, and the stage that `verify` must name first."""

    file: str
    line: str
    planted: str
    recording: str
    stage: str


PLANTS = {
    "nothing": Plant(
        "chsel/qd/selection.py", "def select_elites(", "def select_elites(", "cracker_box_chsel", ""
    ),
    "a constant of the cost": Plant(
        "chsel/cost/pose_lanes.py",
        "value = scale * excess",
        "value = 1.0000000000001 * scale * excess",
        "points_exact_descent",
        "descent, iteration 0",
    ),
    "the order of a sum": Plant(
        "chsel/cost/pose_lanes.py",
        "xs, ys, zs = model.known[0], model.known[1], model.known[2]\n"
        "    for n in range(len(xs)):\n",
        "xs, ys, zs = model.known[0], model.known[1], model.known[2]\n"
        "    for n in range(len(xs) - 1, -1, -1):\n",
        "points_exact_descent",
        "descent, iteration 0",
    ),
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


RUN = """
import sys
from replay.__main__ import main
status = main(["verify", sys.argv[3]])
assert sys.modules[sys.argv[1]].__file__ == sys.argv[2]
sys.exit(status)
"""


def verified_with(plant: Plant, folder: Path) -> subprocess.CompletedProcess[str]:
    """`replay verify` in a copy of the code that has the plant.

    A plant in a kernel is compiled into a folder of its own, which starts with the kept kernels:
    those that can run what is planted are compiled anew.
    """
    original = (REPOSITORY / plant.file).read_text()
    assert original.count(plant.line) == 1
    for package in ("chsel", "replay"):
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / package, folder / package, ignore=unwanted)
    planted = folder / plant.file
    planted.write_text(original.replace(plant.line, plant.planted))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(folder)}
    if "chsel.numerics.compiler" in original:
        kept, unfinished = cache_directory(), shutil.ignore_patterns("*.lock", "*.tmp")
        links = folder / "kept" / kept.name
        shutil.copytree(kept, links, copy_function=os.symlink, ignore=unfinished)
        environment["CHSEL_CACHE_DIR"] = str(folder / "kept")
    module = plant.file.removesuffix(".py").replace("/", ".")
    recording = REPLAYS / f"{plant.recording}.mcap"
    return subprocess.run(
        [sys.executable, "-c", RUN, module, str(planted), str(recording)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, subprocess.CompletedProcess[str]]:
    """All plants verified, two at a time."""
    folder = tmp_path_factory.mktemp("plants")
    with ThreadPoolExecutor(2) as pool:
        folders = [folder / str(index) for index in range(len(PLANTS))]
        return dict(zip(PLANTS, pool.map(verified_with, PLANTS.values(), folders), strict=True))


@pytest.mark.parametrize("name", [name for name, plant in PLANTS.items() if plant.stage])
def test_a_planted_change_is_found_and_its_stage_named(
    name: str, runs: dict[str, subprocess.CompletedProcess[str]]
) -> None:
    done = runs[name]
    assert done.returncode == 1, done.stderr
    stages = re.findall(r"first difference: (.*) \(", done.stdout)
    steps = re.findall(r"step -?\d+, \w+: differs", done.stdout)
    assert len(steps) == len(stages) > 0
    assert set(stages) == {PLANTS[name].stage}, done.stdout


def test_without_a_change_the_bits_are_those_recorded(
    runs: dict[str, subprocess.CompletedProcess[str]],
) -> None:
    """What the tests above see is their plants alone."""
    done = runs["nothing"]
    notices = re.sub(r"compiling the kernels .*\n", "", done.stderr)  # if none are kept yet
    assert (done.returncode, notices) == (0, "")
    assert "4 of 4 steps equal" in done.stdout
