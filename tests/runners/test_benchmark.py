"""The benchmark, as a user runs it, with no package and with a stand-in for it."""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest
import torch

from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from runners import benchmark
from runners.benchmarks.benchmark_report import slower
from runners.benchmarks.registrations import (
    PRESETS,
    PROBLEMS,
    SIZES,
    WORKSPACE,
    Problem,
    Row,
    drill,
    in_turn,
    pose,
    standing,
)
from runners.published_package.process import PublishedPackage
from runners.published_package.worker import GridSdf
from runners.published_package.worker_process import RefusedError
from tests.runners.in_process import run as in_process

FEW = ("quick=true", "repeats=2")


def run(logs, *overrides):
    command = [sys.executable, "-m", "runners.benchmark", *FEW, *overrides, f"logs={logs}"]
    environment = {**os.environ, "COLUMNS": "80", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def found(logs):
    (folder,) = (logs / "benchmark").iterdir()
    return folder, json.loads((folder / "benchmark.json").read_text())["rows"]


@pytest.fixture(scope="module")
def problem():
    return pose(Problem(contacts=7, free_points=3000, hypotheses=4), seed=3)


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory):
    """An interpreter with packages that have the published ones' names and interface."""
    folder = tmp_path_factory.mktemp("stand_in")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    ask = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip())
    (site / "numpy_and_torch.pth").write_text(f"{Path(torch.__file__).parents[1]}\n")
    (site / "chsel.py").write_text(CHSEL)
    (site / "pytorch_volumetric.py").write_text(VOLUMETRIC)
    for name in ("chsel", "pytorch_volumetric", "pytorch_kinematics", "ribs"):
        (site / f"{name}-0.2.1.dist-info").mkdir()
        metadata = f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 0.2.1\n"
        (site / f"{name}-0.2.1.dist-info" / "METADATA").write_text(metadata)
    return python


CHSEL = """
import enum, types
import torch

def volumetric_registration_sgd(
    cost, R, T, max_iterations=10, relative_rmse_thr=1e-6, iterations=50
):
    for _ in range(max_iterations):
        for _ in range(iterations):
            cost(R.clone().requires_grad_(), T, None)
        if 0.0 <= relative_rmse_thr:  # this descent gains nothing
            break

sgd = types.SimpleNamespace(volumetric_registration_sgd=volumetric_registration_sgd)

class SemanticsClass(enum.IntEnum):
    SURFACE = 0
    FREE = 1
    OCCUPIED = 2

class VolumetricDirectSDFCost:
    sign = 1.0
    def __init__(self, free, sdf):
        self.free_voxels, self.sdf = free, sdf
    def __call__(self, R, T, s, other_info=None):
        value, _ = self.sdf(torch.zeros(1, 3))
        return self.sign * (T * T).sum(dim=-1) + value

class VolumetricDoubleDirectCost(VolumetricDirectSDFCost):
    sign = -1.0

class Free:
    def __init__(self, points):
        self.points = points
    def get_known_pos_and_values(self):
        return self.points, None

class CHSEL:
    def __init__(self, sdf, positions, semantics, resolution, free_voxels_resolution,
                 known_sdf_values, savedir, qd_iterations=2, cost=VolumetricDirectSDFCost):
        print("what the package prints must not reach the answers")
        self.iterations = qd_iterations
        self.volumetric_cost = cost(Free(positions[semantics == 1]), sdf)
    def register(self, iterations, initial_tsf, batch):
        R, T = initial_tsf[:, :3, :3].clone(), initial_tsf[:, :3, 3].clone()
        sgd.volumetric_registration_sgd(self.volumetric_cost, R=R, T=T)
        for _ in range(self.iterations):
            self.volumetric_cost(R[:1].clone().requires_grad_(), T[:1], None)
            self.volumetric_cost(R[1:], T[1:], None)
        pose = types.SimpleNamespace(R=initial_tsf[:, :3, :3], T=initial_tsf[:, :3, 3])
        rmse = self.volumetric_cost(pose.R, pose.T, None)
        return types.SimpleNamespace(RTs=pose, rmse=rmse), T[:1].numpy()

class PositionMeasure:
    def __init__(self, dimension):
        pass
    def get_torch_RT(self, x):
        return torch.eye(3).repeat(len(x), 1, 1), torch.tensor(x)

measure = types.SimpleNamespace(PositionMeasure=PositionMeasure)
"""
VOLUMETRIC = """
class CachedSDF:
    def __init__(self, name, resolution, ranges, sdf, cache_path):
        self.sdf = sdf
    def __call__(self, points):
        return self.sdf(points)
"""


def test_free_points_are_a_lattice_around_the_object_and_contacts_touch_it():
    posed = pose(PROBLEMS["real_20"], seed=0)
    (mesh, _) = drill(1.0)
    points = posed.points
    object_from_world = inverse(standing(mesh))
    assert mesh_sdf(mesh, apply(object_from_world, points.free))[0].min() > 0.0
    assert np.abs(mesh_sdf(mesh, apply(object_from_world, points.contacts))[0]).max() < 1e-6
    assert (len(points.free), len(points.contacts)) == (pytest.approx(20_000, rel=0.05), 20)
    steps = points.free / posed.free_resolution
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    lower, upper = WORKSPACE.bounds
    assert ((points.free >= lower - 1e-9) & (points.free <= upper + 1e-9)).all()


def test_the_package_reads_the_nodes_of_our_grid(problem):
    grid = problem.sdf
    bounds = np.array([[-0.1, -0.2, -0.3], [0.4, 0.5, 0.6]])
    values = {"sdf_values": grid.values, "sdf_gradients": grid.gradients, "object_bounds": bounds}
    sdf = GridSdf({**values, "sdf_origin": grid.origin, "sdf_resolution": grid.resolution})
    nodes = np.array([[0, 0, 0], [3, 5, 7], np.array(grid.shape) - 1])
    points = grid.origin + (nodes + 0.3) * grid.resolution
    value, gradient = sdf(torch.tensor(points)[None])
    np.testing.assert_array_equal(value[0].double(), grid.values[tuple(nodes.T)])
    np.testing.assert_array_equal(gradient[0].double(), grid.gradients[tuple(nodes.T)])
    assert sdf(torch.tensor(points[:1] - 1.0))[0] == value[0, 0]
    box = sdf.surface_bounding_box(padding=0.1).double()
    np.testing.assert_allclose(box.T, bounds + np.array([[-0.1], [0.1]]), rtol=1e-6)


def test_measurements_alternate_and_rows_tell_their_middle():
    order: list[str] = []

    def measure(name, value):
        order.append(name)
        return value + len(order)

    measured = {"a": lambda: measure("a", 0.0), "b": lambda: measure("b", 100.0)}
    samples = in_turn(2, measured, first_counts=True)
    assert order == ["a", "b", "a", "b"]
    assert samples == {"a": (1.0, 3.0), "b": (102.0, 104.0)}
    assert in_turn(2, measured) == {"a": (7.0, 9.0), "b": (108.0, 110.0)}
    row = Row("measure", "case", who="who", unit="ms", samples=(4.0, 1.0, 2.0, 3.0, 10.0))
    assert (row.median, row.quartiles) == (3.0, (2.0, 4.0))


def test_ratios_are_of_the_same_problem():
    ours, package, other = (
        Row("registration", case, who=who, unit="ms", samples=(taken,))
        for case, who, taken in (
            ("x", "ours, paper", 2.0),
            ("x", "package", 30.0),
            ("y", "ours, paper", 5.0),
        )
    )
    rows = [ours, package, other]
    assert slower(rows, ours, package="package") == 15.0
    assert (
        slower(rows, package, package="package") is slower(rows, other, package="package") is None
    )


def test_the_worker_does_all_steps_of_the_package_and_counts_them(stand_in, problem):
    with PublishedPackage(stand_in) as package:
        assert package.versions["chsel"] == "0.2.1"
        package.load(problem, drill(1.0)[0].bounds)
        for cost in ("default", "equation"):
            answer = package.register(cost=cost, restarts=3, steps=5, search=7, seed=0)
            assert answer["gradients"] == 3 * 5 + 7
            assert answer["free_points"] == len(problem.points.free)
            assert answer["seconds"] > 0.0
            np.testing.assert_allclose(answer["poses"], problem.initial_set, atol=1e-6)
        answer = package.register(seed=0)  # with all that is the package's own
        assert (answer["gradients"], len(answer["poses"])) == (None, 4)
        with pytest.raises(RefusedError, match=r"FileNotFoundError.*nothing\.npz"):
            package.ask("load", problem="nothing.npz")
        package.load(problem, drill(1.0)[0].bounds)  # an error ends nothing


def test_every_measure_of_this_library_alone_is_in_the_file_and_shown(tmp_path):
    measures = "alone=[stages,threads,plausible_sets]"
    done = run(tmp_path, "package.skip=true", measures)
    assert done.returncode == 0, done.stderr
    folder, rows = found(tmp_path)
    names = {file.name for file in folder.iterdir()}
    assert names == {"benchmark.json", "config.yaml", "speed.md"}
    who = [row["who"] for row in rows if row["measure"] == "registration"]
    assert who == [*(f"ours, {preset}" for preset in PRESETS), *SIZES]
    cases: dict[str, list[str]] = {}
    for row in rows:
        cases.setdefault(row["measure"], []).append(row["case"])
        assert row["median"] == pytest.approx(np.median(row["samples"]))
        assert min(row["samples"]) > 0.0
    assert cases["plausible, threads"] == ["real_20, 1", "real_20, 2", "real_150, 1", "real_150, 2"]
    assert cases["speed-up"] == ["real_20"] * 4 + ["large_20"] * 4
    assert {"descent", "cma_mega", "other"} <= set(cases["stage"])
    assert (folder / "speed.md").read_text().endswith(done.stdout.partition("written: ")[0])


def test_with_the_package_it_is_measured_in_the_same_run(stand_in, tmp_path):
    done = run(tmp_path, f"package.python={stand_in}", "alone=[]")
    assert done.returncode == 0, done.stderr
    _, rows = found(tmp_path)
    ours, package = rows[1], rows[-1]
    assert (ours["who"], package["who"]) == ("ours, paper", "package")
    assert len(package["samples"]) == len(ours["samples"]) == 2
    assert "package: python 3" in done.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("package.python=/nowhere/python", "package.python /nowhere/python does not run"),
        (f"package.python={sys.executable}", "cannot use the published package: ModuleNotFound"),
        ("package.directory=/dev/null/here", "venv failed: "),
        ("package.pip=[--no-such-option] package.directory=DIR", "pip failed: no such option"),
        ("package.equation=[real_7]", "problem is 'real_7'; accepted: real_5, real_20"),
        ("alone=[all]", "alone is 'all'; accepted: stages, threads"),
        ("repeats=0", "repeats is 0; accepted"),
        ("steps.adam=0", "adam is 0; accepted"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, override, message):
    words = override.replace("DIR", str(tmp_path / "environment")).split()
    done = in_process(benchmark.main, *FEW, *words, f"logs={tmp_path / 'logs'}")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert not (tmp_path / "logs").exists()
    assert not list(tmp_path.glob("environment/chsel-*"))  # the next run makes it anew
