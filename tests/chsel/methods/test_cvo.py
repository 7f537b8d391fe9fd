from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, RegistrationProblem, Workspace
from chsel.methods import cvo, preset_settings
from chsel.methods.cvo import Ascent, Cvo, CvoSettings, Product, climb, climbers_at, values_of
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.streams import StreamKey
from tests.chsel.methods.dense_cvo import (
    KERNEL,
    MESH,
    SDF,
    DenseClouds,
    along,
    flows,
    nearby,
    product_of,
    scene,
)
from tests.chsel.methods.scene import Watcher

WORKSPACE = Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))
ASCENT = Ascent(1e-4, 0.8, (0.0, 0.0, 0.0), 7.0, 7.0, -1.0)
QUICK = CvoSettings(ell_min=0.1, c=7.0, origin="world", max_iterations=12)


def problem(
    points: KnownPoints, initial_set: FloatArray, workspace: Workspace = WORKSPACE
) -> RegistrationProblem:
    return RegistrationProblem(SDF, points, initial_set, workspace, 0.02, StreamKey(0, 0))


def value(product: Product, object_from_world: FloatArray) -> float:
    return float(values_of(product, Poses.of(object_from_world[None]).numbers)[0])


def direction(product: Product, object_from_world: FloatArray) -> tuple[FloatArray, float]:
    """The unit flow (6,), and the slope of F along it."""
    out = np.empty((1, 7))
    flows(product, Poses.of(object_from_world[None]).numbers, out)
    xi = out[0, 1:] / 7.0
    xi = xi / np.sqrt((xi**2).sum())
    return xi, float((xi * out[0, 1:]).sum())


@numba.njit
def moved_along(pose, xi, tau):  # type: ignore[no-untyped-def]
    return cvo._moved_along(pose, xi, tau)


@pytest.mark.parametrize("tau", [1e-9, 1e-3, 0.019, 0.021, 0.8])
def test_a_step_is_the_exponential_of_the_flow(tau: float) -> None:
    stream = np.random.default_rng(2)
    turning = stream.normal(size=6)
    for xi in (turning / np.sqrt((turning**2).sum()), np.array([0.0, 0, 0, 0.6, 0, 0.8])):
        start = nearby(1, 3)[0]
        found = np.array(moved_along(tuple(Poses.of(start[None]).numbers[0]), tuple(xi), tau))
        expected = along(start, xi, tau)
        np.testing.assert_allclose(found, Poses.of(expected[None]).numbers[0], rtol=0, atol=1e-15)


def test_the_expansion_along_the_flow_is_that_of_the_sum_over_all_pairs() -> None:
    dense = DenseClouds.of(SDF, scene(30), 0.01)
    for start in nearby(3, 4):
        xi = dense.flow(start)
        xi = xi / np.sqrt((xi**2).sum())
        quartic = dense.quartic(start, xi)
        taus = np.linspace(-0.04, 0.04, 17)
        values = [dense.product(along(start, xi, tau)) for tau in taus]
        fit = np.polynomial.Polynomial.fit(taus, values, 8).convert().coef[1:5]
        np.testing.assert_allclose(quartic, fit, rtol=1e-4)


def test_the_flow_is_the_way_uphill_and_its_slope_that_of_the_inner_product() -> None:
    points = scene()
    dense, product = DenseClouds.of(SDF, points, 0.01), product_of(points, KERNEL)
    for start in nearby(4, 4):
        xi, slope = direction(product, start)
        expected = dense.quartic(start, xi)[0]
        assert slope > 0.0
        assert slope == pytest.approx(expected, 0.01)
        further = value(product, along(start, xi, 0.005)), value(product, along(start, xi, -0.005))
        assert slope == pytest.approx((further[0] - further[1]) / 0.01, 0.02)


def test_a_step_gains_as_much_as_that_to_the_root_of_the_expansion() -> None:
    points = scene()
    dense, product = DenseClouds.of(SDF, points, 0.01), product_of(points, KERNEL)
    gains = []
    for start in nearby(8, 6):
        before = value(product, start)
        climbers = climbers_at(Poses.of(start[None]).numbers, np.array([before]))
        climb(product, ASCENT, climbers, 1, 0, 1, None)
        xi, _ = direction(product, start)
        b, c, d, e = dense.quartic(start, xi)
        roots = np.roots([4 * e, 3 * d, 2 * c, b])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        tau = np.clip(real.min(initial=0.8), 1e-4, 0.8)
        gains.append((climbers.value[0] - before, value(product, along(start, xi, tau)) - before))
    ours, theirs = np.array(gains).T
    assert (ours >= 0.99 * theirs).all()
    assert ours.sum() >= theirs.sum()
    np.testing.assert_array_less(0.0, theirs)


def test_the_inner_product_never_falls_and_is_that_of_the_pose() -> None:
    product, starts = product_of(scene(), KERNEL), nearby(5, 7, 0.2)
    poses = Poses.of(starts).numbers
    climbers = climbers_at(poses, values_of(product, poses))
    for _ in range(30):
        before = climbers.value.copy()
        climb(product, ASCENT, climbers, 1, 0, 5, None)
        assert (climbers.value >= before).all()
        assert ((climbers.value > before) | climbers.done).all()
        np.testing.assert_array_equal(values_of(product, climbers.poses), climbers.value)


@pytest.mark.parametrize("name", ["default", "paper", "reference"])
def test_a_cloud_matches_itself(name: str) -> None:
    settings = replace(preset_settings("cvo", name), max_iterations=3)
    band = SDF.resolution if settings.surface_band is None else settings.surface_band
    nodes = SDF.origin + np.argwhere(SDF.values > -np.inf) * SDF.resolution
    signed = SDF.values.reshape(-1)
    free, surface = nodes[signed > band], nodes[np.abs(signed) <= band]
    points = KnownPoints(free=free, known=surface)
    alike = RegistrationProblem(
        SDF, points, np.eye(4)[None], WORKSPACE, SDF.resolution, StreamKey(0, 0)
    )
    found = Cvo(settings).register(alike)
    assert found.cost[0] == pytest.approx(0.0, abs=2e-3)
    position, rotation = pose_errors(found.object_from_world, np.eye(4), ObjectSymmetry())
    assert position[0] < 1e-3
    assert rotation[0] < 1e-2


def test_the_cost_is_one_minus_the_cosine_of_the_two_clouds() -> None:
    points, starts = scene(), nearby(3, 8)
    found = Cvo(replace(preset_settings("cvo", "paper"), max_iterations=2)).register(
        problem(points, starts)
    )
    dense = DenseClouds.of(SDF, points, 0.01)
    x = DenseClouds(dense.x, dense.x_labels, dense.x, dense.x_labels)
    z = [dense.z[dense.z_labels[:, side] > 0.5] for side in (0, 1)]
    norm = sum(_pair_sum(part) for part in z) * x.product(np.eye(4))
    expected = [
        1.0 - dense.product(transform) / np.sqrt(norm) for transform in found.object_from_world
    ]
    np.testing.assert_allclose(found.cost, expected, rtol=0, atol=2e-3)
    assert (np.diff(found.cost) >= 0.0).all()


def _pair_sum(points: FloatArray) -> float:
    return float(
        sum(0.0064 * np.exp(-((points - z) ** 2).sum(axis=1) / 0.02).sum() for z in points)
    )


WORLD_FROM_OBJECT = compose(
    axis_angle(np.array([0.0, 0.6, 0.8]), np.array(0.4)), np.array([0.03, -0.02, 0.05])
)


def touched_all_over() -> KnownPoints:
    surface = trimesh.sample.sample_surface(MESH, 400, seed=1)[0]
    lattice = np.indices((21, 21, 21)).reshape(3, -1).T * 0.02 - 0.2
    signed = SDF.at(apply(inverse(WORLD_FROM_OBJECT), lattice))[0]
    return KnownPoints(free=lattice[signed > 0.01], known=apply(WORLD_FROM_OBJECT, surface))


def around_truth(count: int) -> FloatArray:
    noise = inverse(nearby(count, 9, 0.03))
    return inverse(np.einsum("ij,bjk->bik", WORLD_FROM_OBJECT, noise))


def test_without_free_space_contacts_all_over_place_the_object() -> None:
    method = Cvo(preset_settings("cvo_no_free_space"))
    found = method.register(problem(touched_all_over(), around_truth(8)))
    position, _ = pose_errors(found.object_from_world, WORLD_FROM_OBJECT, ObjectSymmetry())
    assert position[0] < 0.004
    assert found.cost[0] < 0.05


def test_an_object_in_a_hole_of_free_space_ends_up_there() -> None:
    method: Method = Cvo(replace(preset_settings("cvo"), balanced=True))
    starts = around_truth(4)
    found = method.register(problem(touched_all_over(), starts))
    before, _ = pose_errors(starts, WORLD_FROM_OBJECT, ObjectSymmetry())
    after, _ = pose_errors(found.object_from_world, WORLD_FROM_OBJECT, ObjectSymmetry())
    assert after.max() < 0.01 < before.min()


@pytest.mark.parametrize(
    ("settings", "points"),
    [
        (preset_settings("cvo_no_free_space"), KnownPoints(free=[[0.0, 0.0, 0.0]])),
        (preset_settings("cvo_no_free_space"), KnownPoints(known=[[0, 0, 0]], known_sdf=[0.1])),
        (preset_settings("cvo"), KnownPoints(occupied=[[0.0, 0.0, 0.0]])),
    ],
    ids=["free", "near", "occupied"],
)
def test_without_a_point_to_use_the_starts_come_back(
    settings: CvoSettings, points: KnownPoints
) -> None:
    starts = nearby(4, 10)
    starts[2] = starts[0]
    found = Cvo(settings).register(problem(points, starts))
    np.testing.assert_array_equal(found.object_from_world, starts)
    np.testing.assert_array_equal(found.cost, np.ones(4))
    np.testing.assert_array_equal(found.duplicate, [False, False, True, False])


@pytest.mark.parametrize("origin", ["world", "workspace"])
def test_a_start_that_meets_no_point_stays_where_it_is(origin: str) -> None:
    starts = nearby(3, 11)
    starts[1, :3, 3] += 5.0
    shifted = Workspace((-1.0, -0.3, -0.3), (0.3, 0.3, 0.3))
    settings = replace(QUICK, origin=origin)
    found = Cvo(settings).register(problem(scene(), starts, shifted))
    np.testing.assert_array_equal(found.object_from_world[-1], starts[1])
    assert found.cost[-1] == 1.0
    assert found.cost[1] < 0.9


def test_each_start_climbs_as_if_it_were_alone_on_any_number_of_threads() -> None:
    points, starts = scene(), nearby(5, 13, 0.2)
    with threads(2):
        together = Cvo(QUICK).register(problem(points, starts))
    alone = [Cvo(QUICK).register(problem(points, start[None])) for start in starts]
    order = np.argsort([float(found.cost[0]) for found in alone])
    expected = np.concatenate([alone[n].object_from_world for n in order])
    np.testing.assert_array_equal(together.object_from_world, expected)


def test_an_observer_sees_the_costs_fall() -> None:
    posed, watcher = problem(scene(), nearby(4, 14)), Watcher()
    watched = Cvo(QUICK).register(posed, watcher)
    assert watcher.iterations == [0, 10, 12]
    assert watcher.progressed[-1][:2] == ("ascent", 12)
    costs = [trace.cost for trace in watcher.traces]
    assert (np.diff(costs, axis=0) <= 0.0).all()
    np.testing.assert_array_equal(np.sort(costs[-1]), watched.cost)


def test_the_length_scale_falls_from_ascent_to_ascent() -> None:
    settings = replace(QUICK, ell=0.1, ell_min=0.03, ell_decay=0.5, stop_below=None)
    assert settings.levels == [0.1, 0.05, 0.03]
    watcher = Watcher()
    posed = problem(scene(), nearby(2, 15))
    found = Cvo(settings).register(posed, watcher)
    assert watcher.iterations[0] == 0
    assert 24 < watcher.iterations[-1] <= 36  # in the third ascent, of 12 iterations each
    only = replace(settings, ell=0.03, max_iterations=1, max_step=1e-4)
    again = Cvo(only).register(replace(posed, initial_set=found.object_from_world))
    np.testing.assert_allclose(again.cost, found.cost, rtol=0, atol=1e-3)
    coarse = Cvo(replace(only, ell=0.1, ell_min=0.1)).register(
        problem(scene(), found.object_from_world)
    )
    assert (coarse.cost < found.cost - 0.1).all()


def test_turning_about_the_workspace_the_place_of_the_world_does_not_matter() -> None:
    points, starts = scene(), nearby(3, 16)
    shift = np.array([3.0, -2.0, 1.0])
    away = KnownPoints(free=points.free + shift, known=points.known + shift)
    shifted = starts.copy()
    shifted[:, :3, 3] -= np.einsum("bij,j->bi", starts[:, :3, :3], shift)
    elsewhere = Workspace((2.7, -2.3, 0.7), (3.3, -1.7, 1.3))
    settings = replace(QUICK, origin="workspace")
    here = Cvo(settings).register(problem(points, starts))
    there = Cvo(settings).register(problem(away, shifted, elsewhere))
    np.testing.assert_allclose(there.cost, here.cost, rtol=0, atol=1e-9)
    in_world = Cvo(QUICK).register(problem(away, shifted, elsewhere))
    assert np.abs(in_world.cost - here.cost).max() > 1e-6


def test_balanced_contacts_weigh_as_much_as_free_points() -> None:
    points, starts = scene(60), nearby(3, 17)
    thrice = KnownPoints(free=points.free, known=np.repeat(points.known, 3, axis=0))
    balanced = Cvo(replace(QUICK, balanced=True)).register(problem(points, starts))
    repeated = Cvo(QUICK).register(problem(thrice, starts))
    np.testing.assert_allclose(
        balanced.object_from_world, repeated.object_from_world, rtol=0, atol=1e-9
    )
    plain = Cvo(QUICK).register(problem(points, starts))
    assert np.abs(plain.object_from_world - balanced.object_from_world).max() > 1e-3
