from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from chsel import Hypotheses, KnownPoints, RegistrationProblem, SdfGrid, Workspace
from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import ChselError
from chsel.methods import METHODS, OURS, build_method, preset_settings
from chsel.methods.icp import Icp, IcpSettings
from chsel.methods.medial_constraint.medial_cost import MedialCost, MedialCostSettings
from chsel.methods.method import Method
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.online_registration import pose_problem
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import ArchiveSnapshot
from chsel.problem.settings import PRESETS, settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.methods.l_shape import GRID, MESH, TRUTH

WORKSPACE = Workspace((0.0, -0.1, 0.1), (0.4, 0.3, 0.5))


def known_points(contacts: int = 60) -> KnownPoints:
    surface = trimesh.sample.sample_surface(MESH, contacts, seed=1)[0]
    lattice = np.stack(np.meshgrid(*[np.arange(-0.1, 0.6, 0.05)] * 3, indexing="ij"), -1)
    free = lattice.reshape(-1, 3)
    sdf, _ = GRID.query(apply(inverse(TRUTH), free))
    return KnownPoints(free=free[sdf.numpy() > 0.02], known=apply(TRUTH, surface))


QUICK = {
    "descent": {"restarts": 2, "iterations": 15},
    "emitter": {"iterations": 6},
    "cma_es": {"generations": 15},
}
RELAXED = [
    name
    for name in METHODS
    if isinstance(getattr(preset_settings(name), "cost", None), CostSettings)
]
"""Methods that minimise the relaxed cost."""


def quick(name: str, preset: str = "default", **changes: object) -> Method:
    settings = settings_mapping(preset_settings(name, preset))
    for group in QUICK.keys() & settings.keys():
        settings[group] |= QUICK[group]
    for count in {"iterations", "max_iterations"} & settings.keys():
        settings[count] = 8
    return build_method(name, settings | changes)


def judged(method: Method, problem: RegistrationProblem, poses: np.ndarray) -> np.ndarray | None:
    """Costs of poses by code of its own, for methods whose cost has some."""
    cost = getattr(method.settings, "cost", None)
    if isinstance(cost, CostSettings):
        return RelaxedCost.of(problem, cost).evaluate(poses)
    if isinstance(cost, MedialCostSettings):
        return MedialCost(problem, cost).evaluate(Poses.of(poses))
    return None


def posed(
    method: Method, previous: Hypotheses | None = None, **changes: object
) -> RegistrationProblem:
    points = known_points(12)
    key = StreamKey(3, 1)
    return pose_problem(GRID, points, WORKSPACE, 0.05, key, method.online, previous)


class Watcher:
    """Keeps everything that it is shown."""

    snapshot_interval = 2

    def __init__(self) -> None:
        self.stages: list[tuple[str, int]] = []
        self.archives: list[ArchiveSnapshot] = []

    def progress(self, stage: str, iteration: int, total: int) -> None:
        self.stages.append((stage, iteration))

    def trace(self, stage: str, iteration: int, vectors: np.ndarray, cost: np.ndarray) -> None:
        vectors[:] = np.nan  # even one that scribbles over what it sees
        cost[:] = np.nan

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        self.archives.append(archive)


@pytest.mark.parametrize("name", sorted({*METHODS} - {"icp", "svgd", "cvo", "cvo_no_free_space"}))
def test_a_method_finds_the_pose_of_an_object_touched_all_over(name: str) -> None:
    method = build_method(name)
    problem = pose_problem(
        GRID, known_points(), WORKSPACE, 0.05, StreamKey(0, 0), method.online, None
    )
    found = method.register(problem)
    position, rotation = pose_errors(found.object_from_world, TRUTH, ObjectSymmetry())
    assert position[0] < 0.005
    assert rotation[0] < 0.05


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", METHODS)
def test_hypotheses_are_sorted_by_the_cost_of_exactly_these_poses(name: str, preset: str) -> None:
    method = quick(name, preset)
    problem = posed(method)
    found = method.register(problem)
    assert found.object_from_world.shape == (30, 4, 4)
    assert (np.diff(found.cost) >= 0.0).all()
    cost = judged(method, problem, found.object_from_world)
    if cost is not None:
        np.testing.assert_allclose(found.cost, cost, rtol=1e-9, atol=1e-12)
    assert found.duplicate.sum() == 30 - len(np.unique(found.object_from_world, axis=0))


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", RELAXED)
def test_costs_beyond_all_numbers_are_an_error_that_says_so(name: str, preset: str) -> None:
    cost = settings_mapping(preset_settings(name, preset))["cost"] | {"known_scale": 1e308}
    method = quick(name, preset, cost=cost)
    problem = replace(posed(method), points=KnownPoints(known=50.0 + np.eye(40, 3)))
    with pytest.raises(ChselError, match=r"has a finite cost; accepted: points, SDF and scales"):
        method.register(problem)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", METHODS)
def test_watching_and_threads_change_no_bit(name: str, preset: str) -> None:
    method = quick(name, preset)
    problem = posed(method)
    alone = method.register(problem).digest
    assert method.register(problem, Watcher()).digest == alone
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert method.register(problem).digest == alone
    finally:
        torch.set_num_threads(threads)


def test_fresh_processes_give_the_same_bits_on_any_number_of_threads() -> None:
    code = (
        "import sys, torch; torch.set_num_threads(int(sys.argv[1]));"
        "from tests.chsel.methods.test_methods import METHODS, posed, quick;"
        "print([quick(n).register(posed(quick(n))).digest for n in METHODS])"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code, threads],
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(__file__).resolve().parents[3],
        ).stdout
        for threads in ("1", "2")
    }
    here = f"{[quick(n).register(posed(quick(n))).digest for n in METHODS]}\n"
    assert outputs == {here}


def test_a_whole_session_step_is_a_function_of_its_problem_alone() -> None:
    method = quick("chsel")
    first = method.register(posed(method))
    second = posed(method, first)
    expected = method.register(second).digest
    again = quick("chsel")
    rebuilt = RegistrationProblem(
        SdfGrid(GRID.origin, GRID.resolution, GRID.values, GRID.gradients),
        KnownPoints(second.points.free, known=second.points.known),
        second.initial_set.copy(),
        WORKSPACE,
        0.05,
        StreamKey(3, 1),
        second.low_cost_set.copy(),
    )
    assert rebuilt.digest == second.digest
    assert again.register(rebuilt).digest == expected


def test_snapshots_come_at_start_interval_and_end_and_only_improve() -> None:
    watcher = Watcher()
    method = quick("chsel")
    found = method.register(posed(method), watcher)
    assert [archive.iteration for archive in watcher.archives] == [0, 2, 4, 6]
    coverage = [archive.coverage for archive in watcher.archives]
    assert coverage == sorted(coverage)
    assert found.archive is not None
    assert found.archive.digest == watcher.archives[-1].digest
    assert ("descent", 30) in watcher.stages
    assert watcher.stages[-1] == ("cma_mega", 6)


def test_hypotheses_name_the_archive_cells_that_they_come_from() -> None:
    method = quick("chsel")
    found = method.register(posed(method))
    assert found.archive is not None
    rows = [list(found.archive.cells).index(cell) for cell in found.cell]
    np.testing.assert_array_equal(found.elites[rows], found.object_from_world)


def test_elites_of_the_last_result_enter_the_archive() -> None:
    method = quick("chsel")
    first = method.register(posed(method))
    problem = posed(method, first)
    assert len(problem.low_cost_set) == len(first.elites)
    assert method.register(problem).cost[0] <= first.cost[0] + 1e-9


def test_more_passes_do_not_worsen_the_best_cost() -> None:
    problem = posed(quick("chsel"))
    costs = [quick("chsel", passes=passes).register(problem).cost[0] for passes in (1, 2, 3)]
    assert costs[1] <= costs[0] + 1e-12
    assert costs[2] <= costs[1] + 1e-12


@pytest.mark.parametrize("measure", ["plane_position", "plane_angle", "object_xy"])
def test_on_a_plane_every_hypothesis_stands_on_it(measure: str) -> None:
    settings = settings_mapping(preset_settings("chsel"))
    settings["plane"] = {"plane_height": 0.3}
    settings["archive"] |= {"measure": measure}
    settings["descent"] |= {"restarts": 4, "iterations": 40}
    settings["emitter"] |= {"iterations": 20}
    method = build_method("chsel", settings)
    standing = compose(
        axis_angle(np.array([0.0, 0.0, 1.0]), np.array(2.0)), np.array([0.2, 0.1, 0.3])
    )
    surface = trimesh.sample.sample_surface(MESH, 40, seed=1)[0]
    points = KnownPoints(known=apply(standing, surface))
    problem = pose_problem(GRID, points, WORKSPACE, 0.05, StreamKey(0, 0), method.online, None)
    found = method.register(problem)
    world = inverse(found.object_from_world)
    np.testing.assert_allclose(world[:, 2, 3], 0.3, atol=1e-3)
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-12)
    position, rotation = pose_errors(found.object_from_world[:1], standing, ObjectSymmetry())
    assert position[0] < 0.01
    assert rotation[0] < 0.05


def test_presets_differ_where_paper_and_code_differ() -> None:
    paper, reference, ours = (
        preset_settings("chsel", p) for p in ("paper", "reference", "default")
    )
    assert (paper.cost.free_term, reference.cost.free_term) == ("direct", "interior")
    assert (paper.online.initial, reference.online.initial) == ("so3", "upright")
    assert (paper.cost.lookup, ours.cost.lookup) == ("nearest", "trilinear")
    assert (paper.online.keep_best, reference.online.keep_best) == (False, True)
    assert reference.cost.occupied_scale == 0.0
    assert (paper.output.shortage, reference.output.shortage) == ("fewer", "resample")


@pytest.mark.parametrize("name", OURS)
def test_class_defaults_are_the_default_preset(name: str) -> None:
    settings = preset_settings(name)
    variant = {"chsel_cma_me": {"search": "cma_me"}, "cvo_no_free_space": {"free_space": False}}
    assert settings == replace(type(settings)(), **variant.get(name, {}))
    assert build_method(name).settings == build_method(name, {}).settings == settings


@pytest.mark.parametrize("name", OURS)
def test_one_setting_changes_and_nothing_else(name: str) -> None:
    """Also one of a group, whose other settings have another default in the group's own class."""
    before = settings_mapping(preset_settings(name))
    paths = list(_paths(before))
    assert len(paths) > 5
    for path in paths:
        *groups, last = path
        value = before
        for group in path:
            value = value[group]
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        changes: dict[str, Any] = {last: value + 1 if isinstance(value, int) else 0.9 * value}
        expected = deepcopy(before)
        inner = expected
        for group in groups:
            inner = inner[group]
        inner[last] = changes[last]
        for group in reversed(groups):
            changes = {group: changes}
        assert settings_mapping(build_method(name, changes).settings) == expected, path


def test_a_preset_names_what_differs_alone() -> None:
    for name in OURS:
        if name == "medial_constraint_cma_me":  # of CHSEL's presets; its defaults are its own
            continue
        default = settings_mapping(preset_settings(name))
        for preset, changes in getattr(type(preset_settings(name)), "presets", {}).items():
            assert preset in PRESETS[1:]
            for path in _paths(changes):
                here: Any = changes
                ours: Any = default
                for group in path:
                    here, ours = here[group], ours[group]
                assert here != ours, f"{name}, {preset}: {path}"


def _paths(settings: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """The paths of all settings that are no groups."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from ((name, *path) for path in _paths(value))
        elif not isinstance(value, Mapping):
            yield (name,)


def test_an_installed_class_may_give_the_settings_of_each_preset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Theirs(Icp):
        @staticmethod
        def preset(name: str) -> IcpSettings:
            return IcpSettings(iterations=PRESETS.index(name) + 7)

    monkeypatch.setattr("chsel.methods.registry.METHODS", (*METHODS, "theirs"))
    monkeypatch.setattr(
        "chsel.methods.registry.installed_method", lambda _: (Theirs, IcpSettings())
    )
    assert [preset_settings("theirs", name).iterations for name in PRESETS] == [7, 8, 9]
    changed = build_method("theirs", {"redraw": "registration"}).settings
    assert changed == IcpSettings(iterations=7, redraw="registration")
