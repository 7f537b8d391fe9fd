from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, RegistrationProblem, SdfGrid, Workspace
from chsel.errors import SettingError
from chsel.methods import preset_settings
from chsel.methods.cvo import cvo_kernels as kernels
from chsel.methods.cvo.cvo import Cvo, CvoSettings
from chsel.methods.cvo.cvo_kernels import DONE, VALUE, Ascent, Product, climb, products, scratch
from chsel.methods.cvo.rkhs_fields import Kernel, free_field, surface_field
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import NullObserver
from chsel.problem.settings import PRESETS, build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.dense_cvo import DenseClouds, along, flows, nearby

MESH = trimesh.creation.box([0.12, 0.08, 0.06])
SDF = SdfGrid.from_mesh(MESH, 0.01, padding=0.03)
WORKSPACE = Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))
KERNEL = Kernel(0.1, 0.0064)
ASCENT = Ascent(np.array([1e-4 * 8000.0 ** (k / 15) for k in range(16)]), 7.0, 7.0, -1.0)
QUICK = CvoSettings(ell_min=0.1, c=7.0, origin="world", max_iterations=12)


def scene(count: int = 60) -> KnownPoints:
    stream = np.random.default_rng(1)
    free = stream.uniform(-0.25, 0.25, (count, 3))
    return KnownPoints(free=free, known=stream.uniform(-0.06, 0.06, (20, 3)))


def problem(
    points: KnownPoints, initial_set: FloatArray, workspace: Workspace = WORKSPACE
) -> RegistrationProblem:
    return RegistrationProblem(SDF, points, initial_set, workspace, 0.02, StreamKey(0, 0))


def product_of(points: KnownPoints) -> Product:
    free, surface = free_field(SDF, KERNEL, 0.01), surface_field(SDF, KERNEL, 0.01)
    nothing = free.term(np.zeros((0, 3)), 1.0)
    return Product(free.term(points.free, 1.0), nothing, surface.term(points.contacts, 1.0))


def value(product: Product, object_from_world: FloatArray) -> float:
    out = np.empty(1)
    products(product, Poses.of(object_from_world[None]).numbers, out, 0, 1, scratch())
    return float(out[0])


def direction(product: Product, object_from_world: FloatArray) -> tuple[FloatArray, float]:
    """The unit flow (6,), and the slope of F along it."""
    out = np.empty((1, 7))
    flows(product, Poses.of(object_from_world[None]).numbers, out, scratch())
    xi = out[0, 1:] / 7.0
    xi = xi / np.sqrt((xi**2).sum())
    return xi, float((xi * out[0, 1:]).sum())


@numba.njit
def gone(pose, xi, tau):  # type: ignore[no-untyped-def]
    return kernels._gone(pose, xi, tau)


@pytest.mark.parametrize("tau", [1e-9, 1e-3, 0.019, 0.021, 0.8])
def test_a_step_is_the_exponential_of_the_flow(tau: float) -> None:
    stream = np.random.default_rng(2)
    turning = stream.normal(size=6)
    for xi in (turning / np.sqrt((turning**2).sum()), np.array([0.0, 0, 0, 0.6, 0, 0.8])):
        start = nearby(1, 3)[0]
        found = np.array(gone(tuple(Poses.of(start[None]).numbers[0]), tuple(xi), tau))
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
    dense, product = DenseClouds.of(SDF, points, 0.01), product_of(points)
    for start in nearby(4, 4):
        xi, slope = direction(product, start)
        expected = dense.quartic(start, xi)[0]
        assert slope > 0.0
        assert slope == pytest.approx(expected, 0.01)
        further = value(product, along(start, xi, 0.005)), value(product, along(start, xi, -0.005))
        assert slope == pytest.approx((further[0] - further[1]) / 0.01, 0.02)


def test_a_step_gains_as_much_as_that_to_the_root_of_the_expansion() -> None:
    points = scene()
    dense, product = DenseClouds.of(SDF, points, 0.01), product_of(points)
    gains = []
    for start in nearby(8, 6):
        poses, states = Poses.of(start[None]).numbers, np.zeros((1, 5))
        before = states[0, VALUE] = value(product, start)
        climb(product, ASCENT, poses, states, 1, 0, 1, scratch())
        xi, _ = direction(product, start)
        b, c, d, e = dense.quartic(start, xi)
        roots = np.roots([4 * e, 3 * d, 2 * c, b])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        tau = np.clip(real.min(initial=0.8), 1e-4, 0.8)
        gains.append((states[0, VALUE] - before, value(product, along(start, xi, tau)) - before))
    ours, theirs = np.array(gains).T
    assert (ours >= 0.99 * theirs).all()
    assert ours.sum() >= theirs.sum()
    np.testing.assert_array_less(0.0, theirs)


def test_the_inner_product_never_falls_and_is_that_of_the_pose() -> None:
    product, starts = product_of(scene()), nearby(5, 7, 0.2)
    poses, states = Poses.of(starts).numbers, np.zeros((5, 5))
    products(product, poses, states[:, VALUE], 0, 5, scratch())
    for _ in range(30):
        before = states[:, VALUE].copy()
        climb(product, ASCENT, poses, states, 1, 0, 5, scratch())
        assert (states[:, VALUE] >= before).all()
        assert ((states[:, VALUE] > before) | (states[:, DONE] > 0.0)).all()
        now = np.empty(5)
        products(product, poses, now, 0, 5, scratch())
        np.testing.assert_array_equal(now, states[:, VALUE])


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
    signed = SDF.query(apply(inverse(WORLD_FROM_OBJECT), lattice))[0].numpy()
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


@pytest.mark.parametrize(
    "points",
    [
        KnownPoints(known=[[0.0, 0.0, 0.0]]),
        KnownPoints(known=[[0.0, 0.0, 0.0]] * 3),
        KnownPoints(known=np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], 5)),
        KnownPoints(free=[[0.0, 0.0, 0.0]]),
        KnownPoints(free=[[1e300, -1e300, 1e308]], known=[[0.0, 0.0, 0.0]]),
        KnownPoints(known=[[1e9, 1e9, 1e9], [0.0, 0.0, 0.0]]),
        KnownPoints(free=np.linspace([0.0, 0.0, 0.0], [1e200, -1e200, 1e200], 2500)),
    ],
    ids=["one", "one thrice", "a line", "one free", "far away", "a stray one", "all over"],
)
@pytest.mark.parametrize("name", PRESETS)
def test_few_points_and_odd_ones_make_finite_poses(name: str, points: KnownPoints) -> None:
    settings = replace(preset_settings("cvo", name), max_iterations=5)
    found = Cvo(settings).register(problem(points, nearby(2, 12)))
    assert np.isfinite(found.object_from_world).all()
    assert ((found.cost > -2e-3) & (found.cost <= 1.0)).all()
    assert found.cost[0] < 1.0


def test_each_start_climbs_as_if_it_were_alone_on_any_number_of_threads() -> None:
    points, starts = scene(), nearby(5, 13, 0.2)
    with threads(2):
        together = Cvo(QUICK).register(problem(points, starts))
    alone = [Cvo(QUICK).register(problem(points, start[None])) for start in starts]
    order = np.argsort([float(found.cost[0]) for found in alone])
    expected = np.concatenate([alone[n].object_from_world for n in order])
    np.testing.assert_array_equal(together.object_from_world, expected)


class Watcher(NullObserver):
    def __init__(self) -> None:
        self.iterations: list[int] = []
        self.costs: list[FloatArray] = []

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        self.iterations.append(iteration)
        self.costs.append(cost.copy())
        vectors[:] = np.nan
        cost[:] = np.nan

    def progress(self, stage: str, iteration: int, total: int) -> None:
        assert stage == "ascent"
        assert iteration == self.iterations[-1] <= total


def test_watching_shows_the_costs_fall_and_changes_nothing() -> None:
    posed, watcher = problem(scene(), nearby(4, 14)), Watcher()
    watched = Cvo(QUICK).register(posed, watcher)
    assert watched.digest == Cvo(QUICK).register(posed).digest
    assert watcher.iterations == [0, 10, 12]
    assert (np.diff(watcher.costs, axis=0) <= 0.0).all()
    np.testing.assert_array_equal(np.sort(watcher.costs[-1]), watched.cost)


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


@pytest.mark.parametrize("name", ["cvo", "cvo_no_free_space"])
def test_presets_are_plain_mappings_too(name: str) -> None:
    made = [preset_settings(name, preset) for preset in PRESETS]
    assert len({repr(settings) for settings in made}) == 3
    for settings in made:
        assert build_settings(CvoSettings, settings_mapping(settings), "method") == settings
        assert Cvo(settings).online == settings.online
        assert settings.free_space == (name == "cvo")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ell": 0.0}, "ell is 0.0"),
        ({"ell": 1e-9}, "1e-06 to 1000"),
        ({"c": float("nan")}, "c is nan"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"max_iterations": 10_000_000}, "at most 1_000_000"),
        ({"sp_thres": 0.0065}, "below sigma"),
        ({"min_step": 0.9}, "min_step at most max_step"),
        ({"max_step": 2.0}, "max_step at most 1"),
        ({"ell_decay": 1.0}, "below 1"),
        ({"ell_decay": 0.99, "ell_min": 1e-3}, "more than 20 ascents"),
        ({"origin": "moon"}, "world, workspace"),
        ({"surface_band": -1.0}, "surface_band is -1.0"),
        ({"stop_below": -1.0}, "stop_below is -1.0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        replace(CvoSettings(), **changes)  # type: ignore[arg-type]
