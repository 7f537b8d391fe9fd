"""The published package on the sessions of an evaluation, with a stand-in for its process."""

import enum
import json
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from chsel.problem.poses import inverse
from chsel.problem.registration_problem import RegistrationProblem
from replay.mcap.reader import read_recording
from runners import evaluate, published
from runners.published_package.worker import Worker
from runners.published_package.worker_process import RefusedError
from tests.runners.in_process import run
from tests.runners.test_evaluate import SMALL, table

VERSIONS = {"chsel": "0.2.1", "torch": "2"}


class StandIn:
    """In the place of the package's process: moves the starts by 1 cm, the last the cheapest."""

    def __init__(self, versions=VERSIONS):
        self.versions = versions
        self.problems: list[RegistrationProblem] = []
        self.seeds: list[int] = []
        self.refused: Sequence[int] = ()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def load(self, problem, object_bounds):
        assert object_bounds.shape == (2, 3)
        self.problems.append(problem)

    def register(self, seed):
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
def stand_in(monkeypatch):
    """What the command takes for the package."""
    package = StandIn()
    monkeypatch.setattr(published, "PublishedPackage", lambda python: package)
    return package


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An evaluation of one trial, of one method twice."""
    folder = tmp_path_factory.mktemp("evaluation") / "out"
    done = evaluated(folder)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def evaluated(folder, *more):
    """Run the evaluation, or go on with it."""
    arguments = (f"out={folder}", "workers=1", "methods=[icp]", "draws=2", *more)
    return run(evaluate.main, *SMALL, *arguments)


def register(folder, out, *more):
    """Run the command."""
    return run(published.main, f"dir={folder}", f"out={out}", "package.python=python", *more)


def test_each_step_starts_around_the_best_pose_of_the_one_before(folder, tmp_path, stand_in):
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
    folder, tmp_path, stand_in
):
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
    assert len(seeds) == 2
    assert 0 in seeds


def test_what_is_finished_is_not_registered_again_unless_its_session_or_package_is_another(
    folder, tmp_path, stand_in, monkeypatch
):
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
    folder, tmp_path, stand_in
):
    stand_in.refused = (1,)
    done = register(folder, tmp_path)
    assert done.returncode == 1
    assert "seed 0: package: step 4: RuntimeError: no interior points" in done.stdout
    with np.load(tmp_path / "mustard/seed_0.npz") as sets:
        assert sorted(sets.files) == ["cost_5", "seconds_5", "step_5"]
    assert len(stand_in.problems[1].low_cost_set) == 0  # there is no step before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "dir is missing; pass dir=FOLDER"),
        (["dir=/nowhere"], "experiment.json cannot be read"),
        (["dir=FOLDER", "configurations=drill*"], "configurations names 'drill*'; accepted: all"),
        (["dir=FOLDER", "seeds=3..4"], "seeds=3..4 name no session"),
        (["dir=FOLDER", "draws=0"], "draws is 0; accepted"),
        (["dir=FOLDER", "package.python=/nowhere"], "package.python /nowhere does not run"),
    ],
)
def test_a_mistake_is_one_line(folder, arguments, message):
    done = run(published.main, *(argument.replace("FOLDER", str(folder)) for argument in arguments))
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: ")
    assert message in done.stderr


def test_the_worker_hands_over_all_points_with_their_kinds(tmp_path):
    worker = Worker.__new__(Worker)
    kinds = enum.IntEnum("kinds", {"SURFACE": 0, "FREE": 1, "OCCUPIED": 2})
    worker._chsel = SimpleNamespace(SemanticsClass=kinds)
    worker._volumetric = SimpleNamespace(CachedSDF=lambda *_, **__: "sdf")
    worker._folder = str(tmp_path)
    groups = {name: np.full((n, 3), n) for n, name in enumerate(("known", "free", "occupied"), 1)}
    np.savez(
        tmp_path / "problem.npz",
        sdf_origin=np.zeros(3),
        sdf_resolution=0.01,
        sdf_values=np.zeros((2, 2, 2)),
        sdf_gradients=np.zeros((2, 2, 2, 3)),
        object_bounds=np.zeros((2, 3)),
        initial_set=np.eye(4)[None],
        **groups,
    )
    worker.load(str(tmp_path / "problem.npz"))
    assert worker._positions[:, 0].tolist() == [2.0, 2.0, 1.0, 3.0, 3.0, 3.0]
    assert worker._semantics.tolist() == [1, 1, 0, 2, 2, 2]
