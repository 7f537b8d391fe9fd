"""The benchmark, as a user runs it: with no package, a stand-in for it, and the package itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.container import BarContainer

from chsel.policies import POLICIES
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from runners import benchmark
from runners.benchmarks.benchmark_tables import number, ratios
from runners.benchmarks.comparison import BenchmarkError, require_equal
from runners.benchmarks.decisions import decisions
from runners.benchmarks.measures import methods
from runners.benchmarks.pd_over_time import PD, pd_over_time
from runners.benchmarks.plausible_sets import plausible_sets
from runners.benchmarks.plot import picture_of_benchmark
from runners.benchmarks.problems import PROBLEMS, WORKSPACE, PosedProblem, Problem, drill, pose
from runners.benchmarks.registrations import EQUAL_STEPS, PRESETS, SIZES, Scope, Steps
from runners.benchmarks.timing import Row, in_turn
from runners.evaluation.plan import Trial
from runners.published_package.environment import PackageError
from runners.published_package.problem_file import load_problem
from runners.published_package.process import PublishedPackage
from runners.published_package.worker import GridSdf
from tests.runners.in_process import run as in_process

PUBLISHED_PYTHON = "CHSEL_PUBLISHED_PYTHON"
FEW = ("quick=true", "repeats=2")


def run(logs: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "runners.benchmark", *FEW, *overrides, f"logs={logs}"]
    environment = {**os.environ, "COLUMNS": "80", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def found(logs: Path) -> tuple[Path, dict[str, Any]]:
    (folder,) = (logs / "benchmark").iterdir()
    return folder, json.loads((folder / "benchmark.json").read_text())


@pytest.fixture(scope="module")
def problem() -> PosedProblem:
    return pose(Problem(contacts=7, free_points=3000, hypotheses=4), seed=3)


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter with packages that have the published ones' names and interface."""
    folder = tmp_path_factory.mktemp("stand_in")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    ask = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip())
    (site / "numpy_and_torch.pth").write_text(f"{Path(torch.__file__).parents[1]}\n")
    (site / "chsel").mkdir()
    (site / "chsel" / "__init__.py").write_text(CHSEL)
    (site / "chsel" / "sgd.py").write_text(SGD)
    (site / "pytorch_volumetric.py").write_text(VOLUMETRIC)
    for name in ("chsel", "pytorch_volumetric", "pytorch_kinematics", "ribs"):
        (site / f"{name}-0.2.1.dist-info").mkdir()
        metadata = f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 0.2.1\n"
        (site / f"{name}-0.2.1.dist-info" / "METADATA").write_text(metadata)
    return python


CHSEL = """
import enum, types
import torch
from chsel import sgd

class SemanticsClass(enum.IntEnum):
    SURFACE = 0
    FREE = 1

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
                 qd_iterations, cost, savedir):
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
        return types.SimpleNamespace(RTs=pose), None
"""
SGD = """
def volumetric_registration_sgd(
    cost, R, T, max_iterations=10, relative_rmse_thr=1e-6, iterations=50
):
    for _ in range(max_iterations):
        for _ in range(iterations):
            cost(R.clone().requires_grad_(), T, None)
        if 0.0 <= relative_rmse_thr:  # this descent gains nothing
            break
"""
VOLUMETRIC = """
class CachedSDF:
    def __init__(self, name, resolution, ranges, sdf, cache_path):
        self.sdf = sdf
    def __call__(self, points):
        return self.sdf(points)
"""


def test_free_points_are_a_lattice_around_the_object_and_contacts_touch_it() -> None:
    posed = pose(PROBLEMS["real_20"], seed=0)
    mesh, _ = drill(1.0)
    object_from_world = inverse(posed.world_from_object)
    free, _ = mesh_sdf(mesh, apply(object_from_world, posed.free))
    contacts, _ = mesh_sdf(mesh, apply(object_from_world, posed.contacts))
    assert free.min() > 0.0
    assert np.abs(contacts).max() < 1e-6
    assert len(posed.free) == pytest.approx(20_000, rel=0.05)
    steps = posed.free / posed.free_spacing
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    lower, upper = WORKSPACE.bounds
    assert (posed.free >= lower - 1e-9).all()
    assert (posed.free <= upper + 1e-9).all()
    standing = apply(posed.world_from_object, np.asarray(mesh.vertices))
    assert standing[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_more_free_points_fill_more_space_or_the_same_more_densely() -> None:
    few, many = (pose(Problem(free_points=n, spread=True), 0) for n in (20_000, 60_000))
    dense = pose(Problem(free_points=60_000), 0)
    assert many.free_spacing == few.free_spacing > 1.4 * dense.free_spacing
    assert np.ptp(many.free, axis=0).min() > 1.3 * np.ptp(dense.free, axis=0).min()
    for posed in (many, dense):
        assert len(posed.free) == pytest.approx(60_000, rel=0.05)


def test_a_saved_problem_is_the_same_problem(problem: PosedProblem, tmp_path: Path) -> None:
    problem.save(tmp_path / "problem.npz")
    again = load_problem(tmp_path / "problem.npz")
    assert again.digest == problem.registration_problem().digest
    other = pose(Problem(contacts=7, free_points=3000, hypotheses=4), seed=4)
    assert other.registration_problem().digest != problem.registration_problem().digest


def test_the_package_reads_the_nodes_of_our_grid(problem: PosedProblem, tmp_path: Path) -> None:
    problem.save(tmp_path / "problem.npz")
    with np.load(tmp_path / "problem.npz") as data:
        sdf = GridSdf(dict(data))
    nodes = np.array([[0, 0, 0], [3, 5, 7], np.array(problem.sdf.shape) - 1])
    points = problem.sdf.origin + (nodes + 0.3) * problem.sdf.resolution
    value, gradient = sdf(torch.tensor(points)[None])
    np.testing.assert_array_equal(value[0].double(), problem.sdf.values[tuple(nodes.T)])
    np.testing.assert_array_equal(gradient[0].double(), problem.sdf.gradients[tuple(nodes.T)])
    assert sdf(torch.tensor(points[:1] - 1.0))[0] == value[0, 0]
    box = sdf.surface_bounding_box(padding=0.1).double()
    np.testing.assert_allclose(box[:, 0], problem.object_bounds[0] - 0.1, rtol=1e-6)
    np.testing.assert_allclose(box[:, 1], problem.object_bounds[1] + 0.1, rtol=1e-6)


def test_measurements_alternate_and_rows_tell_their_middle() -> None:
    order: list[str] = []

    def measure(name: str, value: float) -> float:
        order.append(name)
        return value + len(order)

    measured = {"a": lambda: measure("a", 0.0), "b": lambda: measure("b", 100.0)}
    samples = in_turn(2, measured, first_counts=True)
    assert order == ["a", "b", "a", "b"]
    assert samples == {"a": (1.0, 3.0), "b": (102.0, 104.0)}
    assert in_turn(2, measured) == {"a": (7.0, 9.0), "b": (108.0, 110.0)}
    row = Row("measure", "case", "who", "ms", (4.0, 1.0, 2.0, 3.0, 10.0))
    assert (row.median, row.quartiles) == (3.0, (2.0, 4.0))


def test_work_that_is_not_equal_is_not_compared() -> None:
    require_equal("steps", (500, 100), (500, 100))
    with pytest.raises(BenchmarkError, match=r"steps: \(150, 100\) counted, \(500, 100\) expected"):
        require_equal("steps", (150, 100), (500, 100))


def test_ratios_are_of_the_same_problem() -> None:
    rows = [
        {"case": "x", "who": "ours, paper", "median": 2.0},
        {"case": "x", "who": "package", "median": 30.0},
        {"case": "x", "who": "package, Eq. 8", "median": 300.0},
        {"case": "x", "who": "anchored, small", "median": 3.0},
        {"case": "y", "who": "ours, paper", "median": 5.0},
    ]
    assert ratios(rows, rows[0]) == {"package": 15.0, "package, Eq. 8": 150.0}
    assert ratios(rows, rows[3]) == {"package": 10.0, "package, Eq. 8": 100.0}
    assert ratios(rows, rows[1]) == ratios(rows, rows[4]) == {}


def test_the_worker_does_all_steps_of_the_package_and_counts_them(
    stand_in: Path, problem: PosedProblem, tmp_path: Path
) -> None:
    problem.save(tmp_path / "problem.npz")
    with PublishedPackage(stand_in) as package:
        assert package.versions["chsel"] == "0.2.1"
        package.ask("load", problem=str(tmp_path / "problem.npz"))
        for cost in ("default", "equation"):
            answer = package.ask("register", cost=cost, restarts=3, steps=5, search=7, seed=0)
            assert answer["cost_calls"] == 3 * 5 + 2 * 7
            assert answer["cost_calls_with_gradient"] == 3 * 5 + 7
            assert answer["poses_evaluated"] == 4 * (3 * 5 + 7)
            assert answer["free_points"] == len(problem.free)
            assert answer["seconds"] > 0.0
            np.testing.assert_allclose(answer["poses"], problem.initial_set, atol=1e-6)
        with pytest.raises(PackageError, match=r"FileNotFoundError.*nothing\.npz"):
            package.ask("load", problem="nothing.npz")
        package.ask("load", problem=str(tmp_path / "problem.npz"))  # an error ends nothing


def scope(repeats: int) -> Scope:
    return Scope(Steps(), repeats, 0, (), ())


def test_methods_are_measured_in_turn_and_beside_chsel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runners.benchmarks.measures.METHODS", ("icp", "chsel", "gradient_descent"))
    rows = list(methods(scope(repeats=3)))
    taken = {row.case: row.samples for row in rows if row.measure == "method"}
    times = {row.case: row.samples for row in rows if row.measure == "method, chsel = 1"}
    assert list(taken) == list(times) == ["icp", "chsel", "gradient_descent"]
    assert times["chsel"] == (1.0, 1.0, 1.0)
    expected = np.array(taken["gradient_descent"]) / taken["chsel"]
    np.testing.assert_array_equal(times["gradient_descent"], expected)
    assert all(min(samples) > 0.0 for samples in taken.values())


def test_plausible_sets_of_34_million_poses_are_measured() -> None:
    rows = list(plausible_sets(scope(repeats=2)))
    taken = [row for row in rows if row.unit == "ms"]
    cases = [row.case.rpartition(", ") for row in taken]
    contacts = [int(name.rpartition("_")[2]) for name, _, _ in cases]
    assert [count for _, _, count in cases] == ["1", "2"] * 3
    assert 4 <= contacts[0] <= 20  # of the session
    assert contacts[2:] == [20, 20, 150, 150]
    assert all(len(row.samples) == 2 and min(row.samples) > 0.0 for row in taken)
    poses = [row.median for row in rows if row.unit == "poses"]
    assert poses == [15**3 * 10_101] * 3


def test_an_effort_of_a_method_has_its_time_and_its_diversity(monkeypatch) -> None:
    monkeypatch.setattr("runners.benchmarks.pd_over_time._TRIALS", (Trial(10, "box"),))
    monkeypatch.setattr("runners.benchmarks.pd_over_time._STEPS", "8")
    efforts = {"gradient_descent@paper": {f"{n}": {"descent": {"restarts": n}} for n in (1, 12)}}
    monkeypatch.setattr("runners.benchmarks.pd_over_time.EFFORTS", efforts)
    rows = list(pd_over_time(scope(repeats=1)))
    assert [row.case for row in rows] == ["1", "1", "12", "12"]
    times, diversity = rows[::2], rows[1::2]
    assert all(len(row.samples) == 1 and min(row.samples) > 0.0 for row in times)
    assert [row.at for row in diversity] == [row.median for row in times]
    assert times[0].median < times[1].median
    assert diversity[0].median > diversity[1].median > 0.0


def test_every_policy_decides_about_200_actions() -> None:
    rows = list(decisions(scope(repeats=2)))
    assert [row.case.split(",")[0] for row in rows] == [*POLICIES] * 2
    assert [row.at for row in rows] == [30.0] * len(POLICIES) + [100.0] * len(POLICIES)
    assert all("poses, 1" in row.case for row in rows)  # 200 at most
    assert all(len(row.samples) == 2 and min(row.samples) > 0.0 for row in rows)
    by_poses = [np.median([row.median for row in rows if row.at == at]) for at in (30.0, 100.0)]
    assert by_poses[0] < by_poses[1]


def test_without_the_package_everything_shown_is_in_the_file(tmp_path: Path) -> None:
    done = run(tmp_path, "package.skip=true", "alone=[stages,threads,hypotheses,recording,memory]")
    assert done.returncode == 0, done.stderr
    folder, report = found(tmp_path)
    names = {file.name for file in folder.iterdir()}
    assert names == {"benchmark.json", "benchmark.png", "benchmark.csv", "config.yaml", "speed.md"}
    assert (folder / "benchmark.png").read_bytes().startswith(b"\x89PNG")
    who = [row["who"] for row in report["comparison"]]
    assert who == [*(f"ours, {preset}" for preset in PRESETS), *SIZES]
    measures = ["stage", "threads", "speed-up", "hypotheses"]
    measures += ["recording", "recording, added", "peak memory"]
    assert list(dict.fromkeys(row["measure"] for row in report["alone"])) == measures
    lines = done.stdout.splitlines()
    for row in report["comparison"] + report["alone"]:
        assert row["median"] == pytest.approx(np.median(row["samples"]))
        shown = [row["case"], row["who"], number(row["median"])]
        assert any(all(text in line for text in shown) for line in lines), shown
    steps = report["settings"]["steps"]
    did = report["problems"]["real_20"]["did"]
    for preset in EQUAL_STEPS:
        done_steps = {"descent": steps["restarts"] * steps["adam"], "cma_mega": steps["search"]}
        assert did[f"ours, {preset}"]["iterations"] == done_steps
        assert did[f"ours, {preset}"]["poses_descended"] == 30 * done_steps["descent"]
    assert f"paper {30 * done_steps['descent']}, default " in done.stdout
    assert report["machine"]["load_after"] is not None
    assert all(f"written: {folder / name}\n" in done.stdout for name in names)


def test_with_the_package_it_is_measured_in_the_same_run(stand_in: Path, tmp_path: Path) -> None:
    done = run(tmp_path, f"package.python={stand_in}", "alone=[]")
    assert done.returncode == 0, done.stderr
    _, report = found(tmp_path)
    _, ours, default, *_, package = report["comparison"]
    assert (ours["who"], package["who"]) == ("ours, paper", "package")
    assert len(package["samples"]) == len(ours["samples"]) == 2
    for row in (ours, default):
        assert row["faster"] == {"package": package["median"] / row["median"]}
        assert number(row["faster"]["package"]) in done.stdout
    assert report["machine"]["published"]["chsel"] == "0.2.1"
    did = report["problems"]["real_20"]["did"]["package"]
    steps = report["settings"]["steps"]
    calls = steps["restarts"] * steps["adam"] + 2 * steps["search"]
    assert did["cost_calls"] == calls
    assert f"; cost calls of the package {calls}" in done.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("package.python=/nowhere/python", "package.python /nowhere/python does not run"),
        (f"package.python={sys.executable}", "cannot use the published package: ModuleNotFound"),
        ("package.directory=/dev/null/here", "venv failed: "),
        ("package.skp=true", "package has no key 'skp'; did you mean skip?"),
        ("problems=[real_7]", "problem is 'real_7'; accepted: real_5, real_20"),
        ("package.equation=[real_7]", "problem is 'real_7'; accepted: real_5, real_20"),
        ("alone=[all]", "alone is 'all'; accepted: stages, threads"),
        ("repeats=0", "repeats is 0; accepted"),
        ("hypotheses=[0]", "hypotheses is 0; accepted"),
        ("steps.adam=0", "adam is 0; accepted"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(tmp_path: Path, override: str, message: str) -> None:
    done = in_process(benchmark.main, *FEW, override, f"logs={tmp_path}")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


def test_what_pip_complains_about_is_one_line_and_status_2(tmp_path: Path) -> None:
    folder = tmp_path / "environment"
    options = [f"package.directory={folder}", "package.pip=[--no-such-option]"]
    done = run(tmp_path / "logs", *options)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip failed: no such option: --no-such-option" in done.stderr
    assert "package.skip=true" in done.stderr
    assert f"making an environment for chsel 0.2.1 in {folder}" in done.stdout
    assert not list(folder.glob("chsel-*"))  # the next run makes it anew


def test_the_published_package_does_as_many_steps(problem: PosedProblem, tmp_path: Path) -> None:
    if PUBLISHED_PYTHON not in os.environ:
        pytest.skip(f"needs {PUBLISHED_PYTHON}, an interpreter that has chsel==0.2.1")
    problem.save(tmp_path / "problem.npz")
    with PublishedPackage(Path(os.environ[PUBLISHED_PYTHON])) as package:
        package.ask("load", problem=str(tmp_path / "problem.npz"))
        for cost in ("default", "equation"):
            answer = package.ask("register", cost=cost, restarts=3, steps=5, search=7, seed=0)
            # Besides the steps: E' is offered to the archive, and the result is evaluated.
            assert answer["cost_calls"] == 3 * 5 + 2 * 7 + 2
            assert answer["cost_calls_with_gradient"] == 3 * 5 + 7
            assert answer["poses_evaluated"] == 4 * (3 * 5 + 7 + 2)
            assert answer["free_points"] == len(problem.free)
            rotation = np.array(answer["poses"])[:, :3, :3]
            product = np.einsum("bij,bkj->bik", rotation, rotation)
            np.testing.assert_allclose(product, np.tile(np.eye(3), (4, 1, 1)), atol=1e-4)


def test_bars_are_medians_with_their_quartiles_and_times_ours() -> None:
    medians = {"ours, reference": (10.0, 40.0), "package": (500.0, 1600.0)}
    rows = [
        {
            "case": case,
            "who": who,
            "median": value,
            "lower_quartile": 0.75 * value,
            "upper_quartile": 1.5 * value,
            "faster": {} if who == "package" else {"package": 50.0},
        }
        for who, values in medians.items()
        for case, value in zip(("real_5", "real_20"), values, strict=True)
    ]
    machine = dict.fromkeys(
        ("processor", "python", "package torch", "load_before", "load_after"), "-"
    )
    efforts = [("icp", 8.0, 90.0), ("icp", 2.0, 400.0), ("svgd", 5.0, 50.0)]
    alone = [{"measure": PD, "who": who, "at": at, "median": value} for who, at, value in efforts]
    picture = picture_of_benchmark({"comparison": rows, "alone": alone, "machine": machine})
    assert picture is not None
    axes, curves = picture.figure.axes
    assert [line.get_label() for line in curves.lines] == ["icp", "svgd"]
    assert curves.lines[0].get_xydata().tolist() == [[2.0, 400.0], [8.0, 90.0]]
    bars = [one for one in axes.containers if isinstance(one, BarContainer)]
    assert [one.get_label() for one in bars] == list(medians)
    for one, values in zip(bars, medians.values(), strict=True):
        assert [bar.get_height() for bar in one] == list(values)
        ends = [part[:, 1].tolist() for part in one.errorbar[2][0].get_segments()]
        assert ends == [[0.75 * value, 1.5 * value] for value in values]
    assert [text.get_text() for text in axes.texts] == ["10.0\n50.0x", "40.0\n50.0x", "500", "1600"]
    assert picture.data["median"].tolist() == [10.0, 40.0, 500.0, 1600.0, 90.0, 400.0, 50.0]
    assert picture_of_benchmark({"comparison": [], "alone": [], "machine": machine}) is None
