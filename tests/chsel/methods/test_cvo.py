"""CVO and its fields, beside sums over all pairs of points, as its equations have them."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, RegistrationProblem, SdfGrid, Workspace
from chsel.methods import cvo, preset_settings
from chsel.methods.cvo import (
    Ascent,
    ClassTerm,
    Cvo,
    CvoSettings,
    Kernel,
    class_field,
    climb,
    climbers_at,
    cloud_norm,
    flow_at,
    full_cubes,
    values_of,
)
from chsel.methods.method import Method
from chsel.numerics.cell_set import places_for
from chsel.numerics.pose_tuples import pose_at
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse, rotation_vector
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import Watcher

KERNEL = Kernel(0.1, 0.0064)
MESH = trimesh.creation.box([0.12, 0.08, 0.06])
SDF = SdfGrid.from_mesh(MESH, 0.01, padding=0.03)


def scene(count=60):
    """Free points and 20 contacts around the box."""
    stream = np.random.default_rng(1)
    free = stream.uniform(-0.25, 0.25, (count, 3))
    return KnownPoints(free=free, known=stream.uniform(-0.06, 0.06, (20, 3)))


def product_of(points, sdf=SDF):
    """The inner product by fields, with a surface band of a voxel."""
    parts = ("free", points.free), ("surface", points.contacts)
    fields = {name: class_field(sdf, KERNEL, band=sdf.resolution, name=name) for name, _ in parts}
    return tuple(ClassTerm(part.T.copy(), fields[name]) for name, part in parts)


class DenseClouds:
    """Points of the world and nodes of the object in pairs, free ones and those of the surface.

    Labels of the two classes are so far apart that unlike points count nothing, exp(-64).
    """

    def __init__(self, points, sdf=SDF):
        nodes = sdf.origin + np.argwhere(sdf.values > -np.inf) * sdf.resolution
        values = sdf.values.reshape(-1)
        band = sdf.resolution
        surface = np.abs(values) <= band
        self.pairs = (points.free, nodes[values > band]), (points.contacts, nodes[surface])

    def product(self, object_from_world):
        """F(X)."""
        return sum(kernel(apply(object_from_world, x), z).sum() for x, z in self.pairs)

    def flow(self, object_from_world):
        """(omega, u) (6,), not normalised, as sums over pairs in the world."""
        total = np.zeros(6)
        for x, z in self.pairs:
            a = kernel(apply(object_from_world, x), z)
            y = apply(inverse(object_from_world), z)
            total[:3] += np.einsum("nm,nmk->k", a, np.cross(x[:, None], y[None]))
            total[3:] += np.einsum("nm,nmk->k", a, y[None] - x[:, None])
        return total


def kernel(x, z):
    """k(x_i, z_j) (N, M), with that of like labels."""
    apart = ((x[:, None] - z) ** 2).sum(-1)
    return KERNEL.amplitude * np.exp(-apart / (2.0 * KERNEL.ell**2))


def along(object_from_world, xi, *, tau):
    """G Exp(tau xi), the exponential by its series."""
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(np.eye(3), tau * xi[:3])
    twist[:3, 3] = tau * xi[3:]
    total, term = np.eye(4), np.eye(4)
    for n in range(1, 25):
        term = term @ twist / n
        total = total + term
    return object_from_world @ total


def nearby(count, seed, *, reach=0.08):
    """Transforms (count, 4, 4) around the identity."""
    stream = np.random.default_rng(seed)
    turns = rotation_vector(stream.normal(0.0, 0.6, (count, 3)))
    return compose(turns, stream.uniform(-reach, reach, (count, 3)))


@numba.njit(error_model="numpy")
def flows(product, poses, places, out):
    """Fill out (B, 7) with F, sum x_i x h_i and sum h_i, h = R^T grad f, at poses (B, 12)."""
    for n in range(len(poses)):
        flow = flow_at(product, pose_at(poses, n), (0.0, 0.0, 0.0), places)
        for i in range(7):
            out[n, i] = flow[i]


WORKSPACE = Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))
ASCENT = Ascent(1e-4, 0.8, centre=(0.0, 0.0, 0.0), c=7.0, d=7.0, stop_below=-1.0)
QUICK = CvoSettings(ell_min=0.1, c=7.0, origin="world", max_iterations=12)


def problem(points, initial_set, *, workspace=WORKSPACE):
    return RegistrationProblem(
        sdf=SDF,
        points=points,
        initial_set=initial_set,
        workspace=workspace,
        free_resolution=0.02,
        key=StreamKey(0, 0),
    )


def values(product, transforms):
    return values_of(product, Poses.of(transforms).numbers)


def flow(product, transforms):
    """Sums (B, 6) over x_i x h_i and h_i."""
    out = np.full((len(transforms), 7), np.nan)
    flows(product, Poses.of(transforms).numbers, places_for(64), out)
    np.testing.assert_allclose(out[:, 0], values(product, transforms), rtol=1e-12)
    return out[:, 1:]


@numba.njit
def moved_along(pose, xi, tau):
    return cvo._moved_along(pose, xi, tau)


@pytest.mark.parametrize("tau", [1e-9, 1e-3, 0.019, 0.021, 0.8])
def test_a_step_is_the_exponential_of_the_flow(tau):
    stream = np.random.default_rng(2)
    turning = stream.normal(size=6)
    for xi in (turning / np.sqrt((turning**2).sum()), np.array([0.0, 0, 0, 0.6, 0, 0.8])):
        start = nearby(1, 3)[0]
        found = np.array(moved_along(tuple(Poses.of(start[None]).numbers[0]), tuple(xi), tau))
        expected = along(start, xi, tau=tau)
        np.testing.assert_allclose(found, Poses.of(expected[None]).numbers[0], rtol=0, atol=1e-15)


def test_a_step_gains_as_much_as_that_to_the_root_of_the_expansion():
    points = scene()
    dense = DenseClouds(points)
    product = product_of(points)
    gains = []
    near = np.linspace(-0.05, 0.05, 9)
    for start in nearby(8, 6):
        before = values(product, start[None])[0]
        climbers = climbers_at(product, Poses.of(start[None]).numbers)
        climb(
            product, ASCENT, climbers=climbers, iterations=1, first=0, last=1, places=places_for(64)
        )
        xi = flow(product, start[None])[0]
        xi /= np.sqrt((xi**2).sum())
        expansion = np.polyfit(near, [dense.product(along(start, xi, tau=tau)) for tau in near], 8)[
            -5:
        ]
        roots = np.roots(np.polyder(expansion))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        tau = np.clip(real.min(initial=0.8), 1e-4, 0.8)
        theirs = values(product, along(start, xi, tau=tau)[None])[0]
        gains.append((climbers.value[0] - before, theirs - before))
    ours, theirs = np.array(gains).T
    assert (ours >= 0.99 * theirs).all()
    assert ours.sum() >= theirs.sum()
    np.testing.assert_array_less(0.0, theirs)


def test_the_inner_product_never_falls_and_is_that_of_the_pose():
    product = product_of(scene())
    starts = nearby(5, 7, reach=0.2)
    climbers = climbers_at(product, Poses.of(starts).numbers)
    for _ in range(30):
        before = climbers.value.copy()
        climb(
            product, ASCENT, climbers=climbers, iterations=1, first=0, last=5, places=places_for(64)
        )
        assert (climbers.value >= before).all()
        assert ((climbers.value > before) | climbers.done).all()
        np.testing.assert_array_equal(values_of(product, climbers.poses), climbers.value)


def test_the_cost_is_one_minus_the_cosine_of_the_two_clouds():
    points = scene()
    starts = nearby(3, 8)
    found = Cvo(replace(preset_settings("cvo", "paper"), max_iterations=2)).register(
        problem(points, starts)
    )
    dense = DenseClouds(points)
    norms = [
        sum(kernel(part, part).sum() for part in side) for side in zip(*dense.pairs, strict=True)
    ]
    products = np.array([dense.product(transform) for transform in found.object_from_world])
    expected = 1.0 - products / np.sqrt(norms[0] * norms[1])
    np.testing.assert_allclose(found.cost, expected, rtol=0, atol=2e-3)
    assert (np.diff(found.cost) >= 0.0).all()


WORLD_FROM_OBJECT = compose(
    axis_angle(np.array([0.0, 0.6, 0.8]), np.array(0.4)), np.array([0.03, -0.02, 0.05])
)


def touched_all_over():
    surface = trimesh.sample.sample_surface(MESH, 400, seed=1)[0]
    lattice = np.indices((21, 21, 21)).reshape(3, -1).T * 0.02 - 0.2
    signed = SDF.at(apply(inverse(WORLD_FROM_OBJECT), lattice))[0]
    return KnownPoints(free=lattice[signed > 0.01], known=apply(WORLD_FROM_OBJECT, surface))


def around_truth(count):
    noise = inverse(nearby(count, 9, reach=0.03))
    return inverse(np.einsum("ij,bjk->bik", WORLD_FROM_OBJECT, noise))


def test_without_free_space_contacts_all_over_place_the_object():
    method = Cvo(preset_settings("cvo_no_free_space"))
    found = method.register(problem(touched_all_over(), around_truth(8)))
    position, _ = pose_errors(found.object_from_world, WORLD_FROM_OBJECT, symmetry=ObjectSymmetry())
    assert position[0] < 0.004
    assert found.cost[0] < 0.05


def test_an_object_in_a_hole_of_free_space_ends_up_there():
    method: Method = Cvo(replace(preset_settings("cvo"), balanced=True))
    starts = around_truth(4)
    found = method.register(problem(touched_all_over(), starts))
    before, _ = pose_errors(starts, WORLD_FROM_OBJECT, symmetry=ObjectSymmetry())
    after, _ = pose_errors(found.object_from_world, WORLD_FROM_OBJECT, symmetry=ObjectSymmetry())
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
def test_without_a_point_to_use_the_starts_come_back(settings, points):
    starts = nearby(4, 10)
    starts[2] = starts[0]
    found = Cvo(settings).register(problem(points, starts))
    np.testing.assert_array_equal(found.object_from_world, starts)
    np.testing.assert_array_equal(found.cost, np.ones(4))
    np.testing.assert_array_equal(found.duplicate, [False, False, True, False])


def test_a_start_that_meets_no_point_stays_where_it_is():
    starts = nearby(3, 11)
    starts[1, :3, 3] += 5.0
    shifted = Workspace((-1.0, -0.3, -0.3), (0.3, 0.3, 0.3))
    settings = replace(QUICK, origin="workspace")
    found = Cvo(settings).register(problem(scene(), starts, workspace=shifted))
    np.testing.assert_array_equal(found.object_from_world[-1], starts[1])
    assert found.cost[-1] == 1.0
    assert found.cost[1] < 0.9


def test_each_start_climbs_as_if_it_were_alone_on_any_number_of_threads():
    points = scene()
    starts = nearby(5, 13, reach=0.2)
    with threads(2):
        together = Cvo(QUICK).register(problem(points, starts))
    alone = [Cvo(QUICK).register(problem(points, start[None])) for start in starts]
    order = np.argsort([float(found.cost[0]) for found in alone])
    expected = np.concatenate([alone[n].object_from_world for n in order])
    np.testing.assert_array_equal(together.object_from_world, expected)


def test_the_length_scale_falls_from_ascent_to_ascent():
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


def test_turning_about_the_workspace_the_place_of_the_world_does_not_matter():
    points = scene()
    starts = nearby(3, 16)
    shift = np.array([3.0, -2.0, 1.0])
    away = KnownPoints(free=points.free + shift, known=points.known + shift)
    shifted = starts.copy()
    shifted[:, :3, 3] -= np.einsum("bij,j->bi", starts[:, :3, :3], shift)
    elsewhere = Workspace((2.7, -2.3, 0.7), (3.3, -1.7, 1.3))
    settings = replace(QUICK, origin="workspace")
    here = Cvo(settings).register(problem(points, starts))
    there = Cvo(settings).register(problem(away, shifted, workspace=elsewhere))
    np.testing.assert_allclose(there.cost, here.cost, rtol=0, atol=1e-9)
    in_world = Cvo(QUICK).register(problem(away, shifted, workspace=elsewhere))
    assert np.abs(in_world.cost - here.cost).max() > 1e-6


def test_balanced_contacts_weigh_as_much_as_free_points():
    points = scene(60)
    starts = nearby(3, 17)
    thrice = KnownPoints(free=points.free, known=np.repeat(points.known, 3, axis=0))
    balanced = Cvo(replace(QUICK, balanced=True)).register(problem(points, starts))
    repeated = Cvo(QUICK).register(problem(thrice, starts))
    np.testing.assert_allclose(
        balanced.object_from_world, repeated.object_from_world, rtol=0, atol=1e-9
    )
    plain = Cvo(QUICK).register(problem(points, starts))
    assert np.abs(plain.object_from_world - balanced.object_from_world).max() > 1e-3


def test_a_field_gives_what_the_sum_over_all_pairs_gives():
    points = scene()
    transforms = nearby(6, 0)
    dense, product = DenseClouds(points), product_of(points)
    expected = np.array([dense.product(transform) for transform in transforms])
    most = dense.product(np.eye(4))
    np.testing.assert_allclose(values(product, transforms), expected, rtol=0, atol=0.002 * most)
    # The dense flow is of a, that of the field of grad f = sum a (z - p) / ell^2.
    wanted = np.array([dense.flow(transform) for transform in transforms])
    found = flow(product, transforms) * KERNEL.ell**2
    sizes = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(found / sizes, wanted / sizes, rtol=0, atol=0.01)


def test_at_the_nodes_a_field_is_the_sum_but_for_its_truncation():
    nodes = SDF.origin + np.array([[0, 0, 0], [8, 7, 5], [3, 11, 2]]) * SDF.resolution
    points = KnownPoints(free=nodes, known=nodes)
    expected = DenseClouds(points).product(np.eye(4))
    assert values(product_of(points), np.eye(4)[None])[0] == pytest.approx(expected, 1e-6)


def test_a_coarser_field_stands_for_a_fine_grid_all_the_same():
    fine = SdfGrid.from_mesh(trimesh.creation.box([0.06, 0.04, 0.03]), 0.004, padding=0.02)
    points = scene(60)
    transforms = nearby(4, 5)
    dense, product = DenseClouds(points, fine), product_of(points, fine)
    assert product[0].field.box.inverse == pytest.approx(1.0 / 0.008)
    expected = np.array([dense.product(transform) for transform in transforms])
    most = dense.product(np.eye(4))
    np.testing.assert_allclose(values(product, transforms), expected, rtol=0, atol=0.002 * most)


@pytest.mark.parametrize("count", [50, 2100])
def test_the_norm_of_a_cloud_is_the_sum_over_its_pairs(count):
    points = np.random.default_rng(0).uniform(-0.2, 0.3, (count, 3))
    assert cloud_norm(points, KERNEL, lattice=0.01) == pytest.approx(
        kernel(points, points).sum(), 1e-12
    )


def test_the_norm_of_lattice_points_is_that_of_a_field_at_its_nodes():
    lattice = np.indices((14, 15, 16)).reshape(3, -1).T
    points = (lattice * 0.0228)[np.random.default_rng(0).random(len(lattice)) < 0.9] + 0.1234
    found = cloud_norm(points, KERNEL, lattice=0.0228)
    assert found == pytest.approx(kernel(points, points).sum(), 1e-3)


@pytest.mark.parametrize("spacing", [0.01, 0.0228])
def test_a_cube_of_points_is_as_good_as_its_points(spacing):
    lattice = (np.indices((20, 20, 20)).reshape(3, -1).T - 10.0) * spacing
    points = lattice[~(np.abs(lattice) < 4.5 * spacing).all(axis=1)]
    alone, centres, wide = full_cubes(points, KERNEL, lattice=spacing)
    side = 5 if spacing == 0.01 else 2
    assert len(alone) + side**3 * len(centres) == len(points)
    assert len(alone) < 0.6 * len(points)
    field = class_field(SDF, KERNEL, band=0.01, name="free")
    all_alone = (ClassTerm(points.T.copy(), field),)
    cubes = ClassTerm(centres.T.copy(), class_field(SDF, wide, band=0.01, name="free"))
    with_cubes = ClassTerm(alone.T.copy(), field), cubes
    transforms = nearby(5, 2)
    expected, wanted = values(all_alone, transforms), flow(all_alone, transforms)
    np.testing.assert_allclose(values(with_cubes, transforms), expected, rtol=1e-3)
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(flow(with_cubes, transforms) / size, wanted / size, atol=0.005)


def test_cubes_are_made_of_full_lattices_alone():
    off = np.random.default_rng(0).uniform(-0.2, 0.2, (3000, 3))
    for points in (off, off[:5], np.zeros((0, 3))):
        alone, centres, _ = full_cubes(points, KERNEL, lattice=0.01)
        np.testing.assert_array_equal(alone, points)
        assert len(centres) == 0
    twice = np.tile(np.indices((20, 20, 4)).reshape(3, -1).T * 0.02, (2, 1))
    alone, centres, _ = full_cubes(twice, KERNEL, lattice=0.02)
    assert len(alone) + 2**3 * len(centres) == len(twice)
