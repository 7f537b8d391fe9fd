"""The published package on the sessions of an evaluation, with a stand-in for its process."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import RegistrationProblem
from replay.mcap.reader import read_recording
from runners import evaluate, published
from runners.evaluation.contenders import repeat_seed
from runners.published_package.process import PackageError, RefusedError
from runners.published_package.worker import Worker
from tests.runners.in_process import Done, run
from tests.runners.test_evaluate import SMALL, table

VERSIONS = {"chsel": "0.2.1", "torch": "2"}


class StandIn:
    """In the place of the package's process: moves the starts by 1 cm, the last the cheapest."""

    def __init__(self, versions: dict[str, str] = VERSIONS) -> None:
        self.versions = versions
        self.problems: list[RegistrationProblem] = []
        self.seeds: list[int] = []
        self.refused: Sequence[int] = ()

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def load(self, problem: RegistrationProblem, object_bounds: FloatArray) -> None:
        assert object_bounds.shape == (2, 3)
        self.problems.append(problem)

    def register(self, seed: int) -> dict[str, Any]:
        self.seeds.append(seed)
        if len(self.problems) in self.refused:
            raise RefusedError("RuntimeError: no  interior\npoints")
        problem = self.problems[-1]
        poses = problem.initial_set.copy()
        poses[:, 0, 3] += 0.01
        cost = np.linspace(1.0, 0.5, len(poses))
        found = {"seconds": 2.0, "cpu_seconds": 1.5, "free_points": len(problem.points.free)}
        return {**found, "poses": poses.tolist(), "cost": cost.tolist(), "elites": poses.tolist()}


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """What the command takes for the package."""
    package = StandIn()
    monkeypatch.setattr(published, "PublishedPackage", lambda python: package)
    return package


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation of one trial, of one method twice."""
    folder = tmp_path_factory.mktemp("evaluation") / "out"
    done = evaluated(folder)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def evaluated(folder: Path, *more: str) -> Done:
    """Run the evaluation, or go on with it."""
    arguments = (f"out={folder}", "workers=1", "methods=[icp]", "draws=2", *more)
    return run(evaluate.main, *SMALL, *arguments)


def register(folder: Path, out: Path, *more: str) -> Done:
    """Run the command."""
    return run(published.main, f"dir={folder}", f"out={out}", "package.python=python", *more)


def test_each_step_starts_around_the_best_pose_of_the_one_before(
    folder: Path, tmp_path: Path, stand_in: StandIn
) -> None:
    done = register(folder, tmp_path / "sets")
    assert (done.returncode, done.stderr) == (0, "")
    first, second = stand_in.problems
    recorded = read_recording(folder / "trials/mustard/seed_0/icp.mcap")
    problem = recorded.problem(4)
    np.testing.assert_array_equal(first.initial_set, problem.initial_set)  # as others start
    np.testing.assert_array_equal(first.points.free, problem.points.free)
    np.testing.assert_array_equal(first.points.known, problem.points.contacts)
    np.testing.assert_array_equal(first.sdf.values, problem.sdf.values)
    assert len(first.low_cost_set) == 0
    moved = first.initial_set.copy()
    moved[:, 0, 3] += 0.01
    np.testing.assert_allclose(second.low_cost_set, moved, atol=1e-12)
    np.testing.assert_allclose(second.initial_set[0], moved[-1], atol=1e-12)
    away = inverse(second.initial_set)[:, :3, 3] - inverse(moved[-1:])[:, :3, 3]
    assert 0.02 < np.sqrt((away[1:] ** 2).mean()) < 0.1  # 5 cm along each axis
    with np.load(tmp_path / "sets/mustard/seed_0.npz") as sets:
        names = [f"{name}_{step}" for name in ("cost", "seconds", "step") for step in (4, 5)]
        assert sorted(sets.files) == names
        np.testing.assert_allclose(sets["step_4"], inverse(moved[::-1]), atol=1e-12)
        np.testing.assert_allclose(sets["cost_4"], np.linspace(0.5, 1.0, 30))
        assert sets["seconds_5"] == 2.0
    about = json.loads((tmp_path / "sets/mustard/seed_0.about.json").read_text())
    assert about["cpu_seconds"] == {"4": 1.5, "5": 1.5}
    assert about["free_points"]["4"] == len(first.points.free)


def test_draws_differ_in_their_numbers_alone_and_rank_under_labels_of_their_own(
    folder: Path, tmp_path: Path, stand_in: StandIn
) -> None:
    sets = tmp_path / "sets"
    assert register(folder, sets, "draws=2").returncode == 0
    one, _, other, _ = stand_in.problems
    np.testing.assert_array_equal(one.points.free, other.points.free)
    assert not np.isclose(one.initial_set[:, :3, 3], other.initial_set[:, :3, 3]).any()
    assert len(set(stand_in.seeds)) == len(stand_in.seeds) == 4  # two draws of two steps
    done = evaluated(folder, f"outside.package={sets}")
    assert (done.returncode, done.stderr) == (0, "")
    by = {(row["method"], row["step"]): row for row in table(folder)}
    methods = ["icp", "icp+1", "package", "package+1"]
    assert sorted(by) == [(method, step) for method in methods for step in (4, 5)]
    assert {row["status"] for row in by.values()} == {"ok"}
    for step in (4, 5):
        assert len({by[method, step]["diversity"] for method in methods}) == 4
        for name in ("true_cost", "members", "contacts"):  # the session and its set are the same
            assert len({by[method, step][name] for method in methods}) == 1
    seeds = {
        read_recording(folder / f"trials/mustard/seed_0/{name}.mcap").problem(4).key.seed
        for name in ("icp", "icp+1")
    }
    assert seeds == {0, repeat_seed(0, 1)}


def test_what_is_finished_is_not_registered_again_unless_its_session_or_package_is_another(
    folder: Path, tmp_path: Path, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "of which 0 are finished" in register(folder, tmp_path).stdout
    asked = len(stand_in.seeds)
    assert "of which 1 are finished" in register(folder, tmp_path).stdout
    assert "2 sessions, of which 1 are finished" in register(folder, tmp_path, "draws=2").stdout
    assert len(stand_in.seeds) == 2 * asked
    about = tmp_path / "mustard/seed_0.about.json"
    about.write_text(about.read_text().replace('"session": "', '"session": "of another'))
    register(folder, tmp_path)
    stand_in.versions = {**VERSIONS, "torch": "3"}
    register(folder, tmp_path)
    assert len(stand_in.seeds) == 4 * asked


def test_a_step_that_the_package_refuses_is_told_and_the_session_goes_on(
    folder: Path, tmp_path: Path, stand_in: StandIn
) -> None:
    stand_in.refused = (1,)
    done = register(folder, tmp_path)
    assert done.returncode == 1
    assert "seed 0: package: step 4: RuntimeError: no interior points" in done.stdout
    with np.load(tmp_path / "mustard/seed_0.npz") as sets:
        assert sorted(sets.files) == ["cost_5", "seconds_5", "step_5"]
    assert len(stand_in.problems[1].low_cost_set) == 0  # there is no step before


def test_a_process_that_ends_stops_all_and_leaves_what_is_finished(
    folder: Path, tmp_path: Path, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(folder, tmp_path)

    def die(*_: object, **__: object) -> None:
        raise PackageError("its process ended: Killed")

    monkeypatch.setattr(stand_in, "register", die)
    done = register(folder, tmp_path, "draws=2")
    assert (done.returncode, done.stderr) == (2, "error: its process ended: Killed\n")
    assert [path.name for path in tmp_path.rglob("*.npz")] == ["seed_0.npz"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "dir is missing; pass dir=FOLDER"),
        (["dir=/nowhere"], "experiment.json cannot be read"),
        (["dir=FOLDER", "configurations=drill*"], "configurations names 'drill*'; accepted: all"),
        (["dir=FOLDER", "seeds=3..4"], "seeds=3..4 name no session"),
        (["dir=FOLDER", "draws=0"], "draws is 0; accepted"),
        (["dir=FOLDER", "package.python=/nowhere"], "package.python /nowhere does not run"),
        (["dir=FOLDER", "package.skip=true"], "package has no key 'skip'"),
    ],
)
def test_a_mistake_is_one_line(folder: Path, arguments: list[str], message: str) -> None:
    given = [argument.replace("FOLDER", str(folder)) for argument in arguments]
    done = run(published.main, *given)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_worker_hands_over_all_points_and_leaves_the_rest_to_the_package(
    tmp_path: Path,
) -> None:
    asked: dict[str, Any] = {}
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.1, 0.2, 0.3])

    class Package:
        def __init__(self, *arguments: Any, **named: Any) -> None:
            asked.update(named, points=arguments[1], semantics=arguments[2].tolist())
            known = SimpleNamespace(get_known_pos_and_values=lambda: (np.zeros((2, 3)), None))
            self.volumetric_cost = SimpleNamespace(free_voxels=known)

        def register(self, **named: Any) -> tuple[Any, Any]:
            asked.update(named)
            transform = SimpleNamespace(R=poses[:, :3, :3], T=poses[:, :3, 3])
            result = SimpleNamespace(RTs=transform, rmse=torch.tensor([3.0, 1.0, 2.0]))
            return result, np.array([[1.0, 2.0, 3.0]])

    class Measure:
        def __init__(self, dimension: int) -> None:
            pass

        def get_numpy_x(self, rotation: torch.Tensor, position: torch.Tensor) -> np.ndarray:
            return position.numpy()

        def get_torch_RT(self, x: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.eye(3).repeat(len(x), 1, 1), torch.tensor(x)

    published_descent = object()
    worker = Worker.__new__(Worker)
    kinds = SimpleNamespace(
        FREE=SimpleNamespace(value=1),
        SURFACE=SimpleNamespace(value=0),
        OCCUPIED=SimpleNamespace(value=2),
    )
    worker._chsel = SimpleNamespace(
        CHSEL=Package,
        SemanticsClass=kinds,
        measure=SimpleNamespace(PositionMeasure=Measure),
        sgd=SimpleNamespace(volumetric_registration_sgd="another"),
    )
    worker._volumetric = SimpleNamespace(CachedSDF=lambda *_, **__: "sdf")
    worker._descent, worker._folder = published_descent, str(tmp_path)
    low = np.eye(4)[None].repeat(2, axis=0)
    low[:, 1, 3] = 0.5
    np.savez(
        tmp_path / "problem.npz",
        sdf_origin=np.zeros(3),
        sdf_resolution=0.01,
        sdf_values=np.zeros((2, 2, 2)),
        sdf_gradients=np.zeros((2, 2, 2, 3)),
        object_bounds=np.zeros((2, 3)),
        free=np.full((2, 3), 1.0),
        known=np.full((1, 3), 2.0),
        occupied=np.full((1, 3), 3.0),
        known_sdf=np.array([0.005]),
        free_spacing=0.025,
        initial_set=poses.numpy(),
        low_cost_set=low,
    )
    worker.load(str(tmp_path / "problem.npz"))
    answer = worker.register(seed=7)
    assert worker._chsel.sgd.volumetric_registration_sgd is published_descent
    assert asked["points"][:, 0].tolist() == [1.0, 1.0, 2.0, 3.0]
    assert asked["semantics"] == [1, 1, 0, 2]
    assert asked["known_sdf_values"].tolist() == pytest.approx([0.005])
    assert asked["free_voxels_resolution"] == 0.025
    assert not {"cost", "qd_iterations"} & set(asked)  # the package's own
    np.testing.assert_allclose(asked["low_cost_transform_set"], low[:, :3, 3])
    assert answer["cost"] == [3.0, 1.0, 2.0]
    np.testing.assert_allclose(answer["poses"], poses.numpy(), rtol=1e-6)
    assert np.array(answer["elites"])[0, :3, 3].tolist() == [1.0, 2.0, 3.0]
    assert answer["seconds"] > 0.0
    assert answer["free_points"] == 2
