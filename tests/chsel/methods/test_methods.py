"""What every method keeps to, whatever it searches with."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import ChselError
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.medial_constraint import MedialCost, MedialCostSettings
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, check_rigid, inverse
from chsel.problem.settings import PRESETS, settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.laws import every_method, quick
from tests.chsel.methods.scene import (
    ODD,
    STANDING,
    TRUTH,
    Watcher,
    known_points,
    posed,
)

FEW = known_points(TRUTH, 12)
WITH_ARCHIVE = [name for name in METHODS if hasattr(preset_settings(name), "emitter")]
PLANAR = [name for name in METHODS if hasattr(preset_settings(name), "plane")]
WITH_STARTS_NEARBY = ("icp", "svgd", "cvo", "cvo_no_free_space")
"""Methods that find a pose from starts nearby alone."""


def judged(method, problem, *, poses):
    """Costs of poses by code of its own, for methods whose cost has some."""
    cost = getattr(method.settings, "cost", None)
    if isinstance(cost, CostSettings):
        return RelaxedCost.of(problem, cost).evaluate(poses)
    if isinstance(cost, MedialCostSettings):
        return MedialCost(problem, cost).evaluate(Poses.of(poses))
    return None


def assert_whole(found, count):
    """As many rigid poses as E_0 has, by their cost."""
    assert found.object_from_world.shape == (count, 4, 4)
    check_rigid("hypotheses", found.object_from_world)
    assert np.isfinite(found.cost).all()
    assert (np.diff(found.cost) >= 0.0).all()


def assert_found(found, truth, *, within=0.005):
    position, rotation = pose_errors(found.object_from_world[:1], truth, symmetry=ObjectSymmetry())
    assert position[0] < within
    assert rotation[0] < 0.05


@pytest.mark.parametrize("name", sorted({*METHODS} - {*WITH_STARTS_NEARBY}))
def test_a_method_finds_the_pose_of_an_object_touched_all_over(name):
    method = build_method(name)
    problem = posed(method, known_points(TRUTH, 60), key=StreamKey(0, 0))
    assert_found(method.register(problem), TRUTH)


@every_method
def test_results_are_whole_and_neither_observers_nor_threads_change_a_bit(name, preset):
    method = quick(name, preset)
    problem = posed(method, FEW)
    found = method.register(problem)
    assert_whole(found, 30)
    cost = judged(method, problem, poses=found.object_from_world)
    if cost is not None:
        np.testing.assert_allclose(found.cost, cost, rtol=1e-9, atol=1e-12)
    assert found.duplicate.sum() == 30 - len(np.unique(found.object_from_world, axis=0))
    assert method.register(problem, Watcher(snapshot_interval=2)).digest == found.digest
    with threads(2):
        assert method.register(problem).digest == found.digest
    assert_whole(method.register(replace(problem, initial_set=problem.initial_set[:1])), 1)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", [name for name in METHODS if name != "anchored"])
def test_odd_points_have_results(name, preset):
    method = quick(name, preset)
    for points in ODD.values():
        found = method.register(posed(method, points))
        assert_whole(found, 30)
        if name.startswith("cvo"):  # one minus a cosine, of sums that are approximated
            assert ((found.cost > -2e-3) & (found.cost <= 1.0)).all()


def test_a_point_far_outside_of_the_workspace_costs_its_distance():
    method = quick("chsel")
    found = method.register(posed(method, KnownPoints(known=[[1e6, 0.0, 0.0]])))
    assert found.cost[0] == pytest.approx(1e6, rel=1e-4)


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("name", ["icp", "medial_constraint"])
def test_costs_beyond_all_numbers_are_an_error_that_says_so(name):
    method = quick(name)
    with pytest.raises(ChselError, match=r"has a finite cost; accepted"):
        method.register(posed(method, KnownPoints(known=np.full((3, 3), 1e200))))


@pytest.mark.parametrize(
    ("name", "measure"),
    [*((name, None) for name in PLANAR)]
    + [("chsel", measure) for measure in ("plane_position", "plane_angle", "object_xy")],
)
def test_on_a_plane_every_hypothesis_stands_on_it(name, measure):
    settings = settings_mapping(preset_settings(name))
    settings["plane"] = {"plane_height": 0.3}
    if measure is not None:
        settings["archive"] |= {"measure": measure}
    if "emitter" in settings:
        settings["emitter"] |= {"iterations": 20}
    if "descent" in settings:
        settings["descent"] |= {"restarts": 4, "iterations": 40}
    method = build_method(name, settings)
    found = method.register(posed(method, known_points(STANDING, 40)))
    world = inverse(found.object_from_world)
    np.testing.assert_allclose(world[:, 2, 3], 0.3, atol=1e-3)
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-12)
    if name not in WITH_STARTS_NEARBY:
        assert_found(found, STANDING, within=0.01)


@pytest.mark.parametrize("name", WITH_ARCHIVE)
def test_snapshots_of_the_archive_come_at_start_interval_and_end_and_only_improve(name):
    watcher = Watcher(snapshot_interval=2)
    method = quick(name)
    found = method.register(posed(method, FEW), watcher)
    assert [archive.iteration for archive in watcher.archives] == [0, 2, 4, 6]
    coverage = [archive.coverage for archive in watcher.archives]
    assert coverage == sorted(coverage)
    assert coverage[-1] > coverage[0]
    assert found.archive is not None
    assert found.archive.digest == watcher.archives[-1].digest
    assert watcher.progressed[-1] == ("cma_mega" if name == "chsel" else "cma_me", 6, 6)
    rows = [list(found.archive.cells).index(cell) for cell in found.cell]
    np.testing.assert_array_equal(found.elites[rows], found.object_from_world)


@pytest.mark.parametrize("name", WITH_ARCHIVE)
def test_poses_of_the_low_cost_set_enter_the_archive(name):
    method = quick(name)
    truth = inverse(TRUTH)[None]
    without = posed(method, FEW)
    problem = posed(method, FEW, low_cost_set=truth)
    cost = judged(method, problem, poses=truth)
    assert cost is not None
    assert method.register(without).cost[0] > 2.0 * cost[0]
    assert method.register(problem).cost[0] <= cost[0] * (1.0 + 1e-9)
    first = method.register(without)
    assert len(posed(method, FEW, previous=first).low_cost_set) == len(first.elites)


def test_more_passes_do_not_worsen_the_best_cost():
    problem = posed(quick("chsel"), FEW)
    costs = [quick("chsel", passes=passes).register(problem).cost[0] for passes in (1, 2, 3)]
    assert costs[1] <= costs[0] + 1e-12
    assert costs[2] <= costs[1] + 1e-12
