from __future__ import annotations

import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, SdfGrid
from chsel.errors import SettingError
from chsel.methods import cvo
from chsel.methods.cvo import (
    Kernel,
    Product,
    class_field,
    cloud_norm,
    full_cubes,
    values_of,
)
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import Poses
from tests.chsel.methods.dense_cvo import KERNEL, SDF, DenseClouds, flows, nearby, product_of, scene


def values(product: Product, transforms: FloatArray) -> FloatArray:
    return values_of(product, Poses.of(transforms).numbers)


def flow(product: Product, transforms: FloatArray) -> FloatArray:
    """Sums (B, 6) over x_i x h_i and h_i."""
    out = np.full((len(transforms), 7), np.nan)
    flows(product, Poses.of(transforms).numbers, out)
    np.testing.assert_allclose(out[:, 0], values(product, transforms), rtol=1e-12)
    return out[:, 1:]


def test_a_field_gives_what_the_sum_over_all_pairs_gives() -> None:
    points, transforms = scene(), nearby(6, 0)
    dense = DenseClouds.of(SDF, points, SDF.resolution)
    product = product_of(points, KERNEL)
    expected = np.array([dense.product(transform) for transform in transforms])
    most = dense.product(np.eye(4))
    np.testing.assert_allclose(values(product, transforms), expected, rtol=0, atol=0.002 * most)
    # The dense flow is of a, that of the field of grad f = sum a (z - p) / ell^2.
    wanted = np.array([7.0 * dense.flow(transform) for transform in transforms])
    found = flow(product, transforms) * KERNEL.ell**2
    sizes = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(found / sizes, wanted / sizes, rtol=0, atol=0.01)


def test_at_the_nodes_a_field_is_the_sum_but_for_its_truncation() -> None:
    nodes = SDF.origin + np.array([[0, 0, 0], [8, 7, 5], [3, 11, 2]]) * SDF.resolution
    points = KnownPoints(free=nodes, known=nodes)
    dense = DenseClouds.of(SDF, points, SDF.resolution)
    expected = dense.product(np.eye(4))
    assert values(product_of(points, KERNEL), np.eye(4)[None])[0] == pytest.approx(expected, 1e-6)


def test_points_of_different_classes_have_next_to_no_kernel() -> None:
    points = KnownPoints(free=[[0.0, 0.0, 0.0]], known=[[0.0, 0.0, 0.0]])
    dense = DenseClouds.of(SDF, points, SDF.resolution)
    a = dense.kernel(np.eye(4))
    surface = dense.z_labels[:, 1] > 0.5
    assert (a[0, surface] < 1e-27 * a.max()).all()
    assert (a[1, ~surface] < 1e-27 * a.max()).all()
    assert (a[1, surface] > 0.0).any()


def test_a_coarser_field_stands_for_a_fine_grid_all_the_same() -> None:
    fine = SdfGrid.from_mesh(trimesh.creation.box([0.06, 0.04, 0.03]), 0.004, padding=0.02)
    points, transforms = scene(60), nearby(4, 5)
    dense = DenseClouds.of(fine, points, fine.resolution)
    product = product_of(points, KERNEL, fine)
    assert product.free.box.inverse == pytest.approx(1.0 / 0.008)
    expected = np.array([dense.product(transform) for transform in transforms])
    most = dense.product(np.eye(4))
    np.testing.assert_allclose(values(product, transforms), expected, rtol=0, atol=0.002 * most)


def test_a_field_is_made_once_for_a_grid() -> None:
    sdf = SdfGrid(SDF.origin, SDF.resolution, SDF.values, SDF.gradients)
    assert class_field(sdf, KERNEL, 0.01, "free") is class_field(sdf, KERNEL, 0.01, "free")
    assert class_field(sdf, KERNEL, 0.01, "free") is not class_field(sdf, KERNEL, 0.02, "free")
    assert class_field(sdf, KERNEL, 0.01, "free") is not class_field(sdf, KERNEL, 0.01, "surface")


def test_a_field_too_large_for_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cvo, "MOST_NODES", 1000)
    with pytest.raises(SettingError, match="a smaller ell"):
        class_field(SDF, Kernel(0.02, 1.0), 0.0123, "surface")
    with pytest.raises(SettingError, match="a smaller ell"):
        class_field(SDF, Kernel(1e6, 1.0), 0.0123, "surface")


def pair_sum(points: FloatArray) -> float:
    total = 0.0
    for point in points:
        apart = np.minimum(np.abs(points - point), 1e3)
        total += np.exp(-(apart**2).sum(axis=1) / (2 * KERNEL.ell**2)).sum()
    return KERNEL.amplitude * float(total)


@pytest.mark.parametrize("count", [50, 2100])
def test_the_norm_of_a_cloud_is_the_sum_over_its_pairs(count: int) -> None:
    points = np.random.default_rng(0).uniform(-0.2, 0.3, (count, 3))
    expected = pair_sum(points)
    tolerance = 1e-12 if count == 50 else 0.002
    assert cloud_norm(points, KERNEL, 0.01) == pytest.approx(expected, tolerance)


def test_the_norm_of_lattice_points_is_that_of_a_field_at_its_nodes() -> None:
    lattice = np.indices((14, 15, 16)).reshape(3, -1).T
    points = (lattice * 0.0228)[np.random.default_rng(0).random(len(lattice)) < 0.9] + 0.1234
    found = cloud_norm(points, KERNEL, 0.0228)
    assert found == pytest.approx(pair_sum(points), 1e-3)


def test_points_all_over_the_world_are_summed_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (2100, 3))
    for scale in (1.0, 1e300):
        points[0] = scale * 1e6
        assert cloud_norm(points, KERNEL, 0.01) == pytest.approx(pair_sum(points), 1e-9)
    monkeypatch.setattr(cvo, "_MANY", 2050)
    with pytest.raises(SettingError, match="2100 points of one class are far apart"):
        cloud_norm(points, KERNEL, 0.01)


@pytest.mark.parametrize("spacing", [0.01, 0.0228])
def test_a_cube_of_points_is_as_good_as_its_points(spacing: float) -> None:
    lattice = (np.indices((20, 20, 20)).reshape(3, -1).T - 10.0) * spacing
    points = lattice[~(np.abs(lattice) < 4.5 * spacing).all(axis=1)]
    alone, centres, wide = full_cubes(points, KERNEL, spacing)
    side = 5 if spacing == 0.01 else 2
    assert len(alone) + side**3 * len(centres) == len(points)
    assert len(alone) < 0.6 * len(points)
    field = class_field(SDF, KERNEL, 0.01, "free")
    nothing = field.term(np.zeros((0, 3)), 1.0)
    all_alone = Product(field.term(points, 1.0), nothing, nothing)
    cubes = class_field(SDF, wide, 0.01, "free").term(centres, 1.0)
    with_cubes = Product(field.term(alone, 1.0), cubes, nothing)
    transforms = nearby(5, 2)
    expected, wanted = values(all_alone, transforms), flow(all_alone, transforms)
    np.testing.assert_allclose(values(with_cubes, transforms), expected, rtol=1e-3)
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(flow(with_cubes, transforms) / size, wanted / size, atol=0.005)


def test_cubes_are_made_of_full_lattices_alone() -> None:
    off = np.random.default_rng(0).uniform(-0.2, 0.2, (3000, 3))
    for points in (off, off[:5], np.zeros((0, 3))):
        alone, centres, _ = full_cubes(points, KERNEL, 0.01)
        np.testing.assert_array_equal(alone, points)
        assert len(centres) == 0
    twice = np.tile(np.indices((20, 20, 4)).reshape(3, -1).T * 0.02, (2, 1))
    alone, centres, _ = full_cubes(twice, KERNEL, 0.02)
    assert len(alone) + 2**3 * len(centres) == len(twice)
