"""Symmetries of bodies whose groups are known, and of scans."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq

from chsel.errors import PoseError, SettingError
from chsel.plausible import pose_scan
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.plausible.pose_scan import PoseGrid, TruePoseSettings, find_true_pose
from chsel.plausible.symmetry import (
    ObjectSymmetry,
    RotatedSurface,
    generated,
    grid_symmetry,
    object_symmetry,
)
from chsel.problem.mesh import load_mesh
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, axis_angle, compose, inverse, rotation_angle, rotation_vector
from chsel.problem.sdf_grid import SdfGrid
from runners.objects.loader import load_model
from tests.chsel.plausible.scenes import box, scene

ANYWHERE = compose(rotation_vector(np.array([0.7, -0.4, 1.1])), np.array([0.3, -2.0, 0.9]))
X, Y, Z = np.eye(3)
SCANS = {
    "003_cracker_box": 4,
    "006_mustard_bottle": 2,
    "010_potted_meat_can": 2,
    "035_power_drill": 1,
    "048_hammer": 1,
    "050_medium_clamp": 1,
}


def half_turn(axis):
    return 2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3)


def turns_about(axis, count):
    angles = np.arange(float(count)) * (2.0 * np.pi / count)
    return axis_angle(np.tile(axis, (count, 1)), angles)


def dihedral(count, across=X):
    about = turns_about(Z, count)
    return np.concatenate([about, about @ half_turn(across)])


def cube_rotations():
    signed = [
        np.eye(3)[list(order)] * signs
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array([one for one in signed if np.linalg.det(one) > 0.0])


def assert_same_set(found, expected, *, within=1e-6):
    assert len(found) == len(expected)
    apart = np.abs(found[:, None] - expected).max(axis=(2, 3))
    assert (apart.min(axis=0) < within).all()


def mug():
    """A cup with a bottom and a handle."""
    outer = trimesh.creation.cylinder(0.04, 0.1)
    inner = trimesh.creation.cylinder(0.036, 0.1)
    inner.apply_translation([0.0, 0.0, 0.004])
    handle = trimesh.creation.torus(0.025, 0.005)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, X))
    handle.apply_translation([0.04, 0.0, 0.0])
    solid = trimesh.boolean.union([outer, handle], engine="manifold")
    return trimesh.boolean.difference([solid, inner], engine="manifold")


def tetrahedron():
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.05
    return trimesh.convex.convex_hull(corners)


FINITE = {
    "box": (trimesh.creation.box((0.1, 0.2, 0.3)), dihedral(2)),
    "cube": (trimesh.creation.box((0.2, 0.2, 0.2)), cube_rotations()),
    "square prism": (trimesh.creation.box((0.1, 0.1, 0.3)), dihedral(4)),
    "prism of 6": (trimesh.creation.cylinder(0.05, 0.2, sections=6), dihedral(6)),
    "prism of 3": (trimesh.creation.cylinder(0.05, 0.1, sections=3), dihedral(3)),
    "sheet": (trimesh.creation.box((0.2, 0.1, 0.0005)), dihedral(2)),
    "mug": (mug(), np.eye(3)[None]),
    "drill": (load_model("drill"), np.eye(3)[None]),
}


@pytest.mark.parametrize("name", FINITE)
def test_finite_groups_are_found_in_any_frame(name):
    mesh, expected = FINITE[name]
    for pose in (np.eye(4), ANYWHERE):
        turned = mesh.copy().apply_transform(pose)
        found = object_symmetry(turned)
        back = pose[:3, :3].T @ found.rotations @ pose[:3, :3]
        assert_same_set(back, expected)
        np.testing.assert_array_equal(found.rotations[0], np.eye(3))
        assert found.axis is None
        assert not found.sphere


@pytest.mark.parametrize(
    ("mesh", "count"), [(tetrahedron(), 12), (trimesh.creation.icosahedron(), 60)]
)
def test_groups_of_regular_bodies_are_complete(mesh, count):
    found = object_symmetry(mesh).rotations
    assert len(found) == count
    again = generated(found, same=np.deg2rad(10.0))
    assert_same_set(again, found)
    corners = mesh.vertices - mesh.vertices.mean(axis=0)
    for rotation in found:
        apart = np.linalg.norm((corners @ rotation.T)[:, None] - corners, axis=2)
        assert apart.min(axis=1).max() < 1e-9


@pytest.mark.parametrize(
    ("mesh", "ends_swap"),
    [
        (trimesh.creation.cylinder(0.03, 0.2), True),
        (trimesh.creation.annulus(0.03, 0.05, 0.1), True),
        (trimesh.creation.torus(0.1, 0.03), True),
        (trimesh.creation.capsule(0.2, 0.05), True),
        (trimesh.creation.cone(0.05, 0.2), False),
    ],
)
def test_axes_of_revolution_are_found(mesh, ends_swap):
    found = object_symmetry(mesh.copy().apply_transform(ANYWHERE))
    assert abs(found.axis @ ANYWHERE[:3, 2]) == pytest.approx(1.0, abs=1e-9)
    assert len(found.rotations) == 1 + ends_swap
    if ends_swap:
        np.testing.assert_allclose(found.rotations[1] @ found.axis, -found.axis, atol=1e-9)


def moments(mesh):
    """Second moments (3, 3) of a surface about the origin: edge middles are exact for squares."""
    middles = (mesh.triangles + np.roll(mesh.triangles, 1, axis=1)) / 2.0
    return np.einsum("f,fki,fkj->ij", mesh.area_faces, middles, middles)


def test_an_axis_is_found_where_all_moments_of_inertia_are_equal():
    def difference(height):
        found = moments(trimesh.creation.cylinder(0.05, height))
        return float(found[2, 2] - found[0, 0])

    can = trimesh.creation.cylinder(0.05, brentq(difference, 0.05, 0.1, xtol=1e-15))
    spread = np.linalg.eigvalsh(moments(can))
    assert np.ptp(spread) < 1e-12 * spread[0]
    found = object_symmetry(can.apply_transform(ANYWHERE))
    assert abs(found.axis @ ANYWHERE[:3, 2]) == pytest.approx(1.0, abs=1e-9)


def test_an_axis_is_found_in_a_scan_whose_normals_are_noise():
    can = trimesh.creation.cylinder(0.033, 0.1, sections=64)
    for _ in range(4):
        can = can.subdivide()
    noise = 3e-4 * np.random.default_rng(0).normal(size=can.vertices.shape)
    found = object_symmetry(trimesh.Trimesh(can.vertices + noise, can.faces, process=False))
    assert abs(found.axis[2]) > np.cos(0.01)
    assert len(found.rotations) == 2


def test_a_sheet_without_a_thickness_turns_over():
    """Points that stay within its borders do not show small rotations in its plane."""
    square = trimesh.Trimesh([X * 0, X, X + Y, Y], [[0, 1, 2], [0, 2, 3]], process=False)
    assert_same_set(object_symmetry(square).rotations, dihedral(4), within=2e-3)


def test_coarse_errors_are_mean_distances_in_diameters():
    surface = RotatedSurface(trimesh.creation.box((0.2, 0.5, 1.0)))
    turns = rotation_vector(np.random.default_rng(0).normal(size=(20, 3)))
    expected = np.sqrt(surface._closest(turns, 128)[1]).mean(axis=1) / 2.0
    assert expected.max() > 0.1
    np.testing.assert_allclose(surface.coarse_errors(turns), expected, atol=0.015)


def test_a_sphere_has_all_rotations():
    found = object_symmetry(trimesh.creation.icosphere(3, 0.1))
    assert found.sphere
    assert found.rotation_errors(rotation_vector(np.array([[0.0, 1.0, 2.0]]))).tolist() == [0.0]


def test_an_open_end_is_not_the_other_end():
    can = trimesh.creation.cylinder(0.05, 0.2)
    can.update_faces(can.triangles_center[:, 2] < 0.099)
    found = object_symmetry(can)
    assert found.axis is not None
    assert len(found.rotations) == 1


def test_the_tolerance_is_a_share_of_the_diameter():
    """A quarter turn of a bar whose sides differ by 3 and by 8 parts in 100."""
    assert len(object_symmetry(trimesh.creation.box((1.0, 1.03, 3.0))).rotations) == 8
    assert len(object_symmetry(trimesh.creation.box((1.0, 1.08, 3.0))).rotations) == 4
    # Quarter turns about two axes would be within it alone, but not what they make together.
    assert len(object_symmetry(trimesh.creation.box((1.0, 1.02, 1.04))).rotations) == 8


def test_a_small_knob_is_seen_and_a_tiny_one_is_not():
    for size, seen in ((0.006, False), (0.02, True)):
        knob = trimesh.creation.box((size, size, size))
        knob.apply_translation([0.05, 0.0, 0.0])
        body = trimesh.creation.cylinder(0.05, 0.1)
        found = object_symmetry(trimesh.boolean.union([body, knob], engine="manifold"))
        assert (found.axis is None) == seen


def test_the_centre_is_where_every_symmetry_leaves_it():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.apply_translation([7.0, -3.0, 0.5])
    np.testing.assert_allclose(object_symmetry(mesh).centre, [7.0, -3.0, 0.5], atol=1e-12)
    cone = trimesh.creation.cone(0.3, 0.4, sections=256)  # from z = 0 to 0.4, slant 0.5
    areas = np.array([0.3**2, 0.3 * 0.5])
    heights = np.array([0.0, 0.4 / 3])
    expected = [0.0, 0.0, areas @ heights / areas.sum()]
    np.testing.assert_allclose(object_symmetry(cone).centre, expected, atol=1e-5)


@pytest.mark.parametrize(("name", "count"), SCANS.items())
def test_models_and_scans_have_the_symmetries_of_their_objects(name, count, ycb_directory):
    mesh = load_mesh(ycb_directory / name / "google_16k" / "nontextured.ply")
    found = object_symmetry(mesh)
    assert len(found.rotations) == count
    assert found.axis is None
    for rotation in found.rotations[1:]:  # half turns
        np.testing.assert_allclose(rotation @ rotation, np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "count", "round_about"),
    [("icub_cylinder", 2, True), ("icub_lego", 1, False), ("ycbv_gelatin_box", 4, False)],
)
def test_meshes_of_real_measurements(name, count, round_about, real_directory):
    found = object_symmetry(load_mesh(real_directory / f"{name}.obj"))
    assert (len(found.rotations), found.axis is not None) == (count, round_about)


def test_without_a_mesh_there_is_the_centre_of_the_grid_alone():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.apply_translation([0.4, 0.0, 0.1])
    found = grid_symmetry(SdfGrid.from_mesh(mesh, 0.01))
    assert_same_set(found.rotations, np.eye(3)[None])
    np.testing.assert_allclose(found.centre, [0.4, 0.0, 0.1], atol=0.005)
    thin = SdfGrid(np.zeros(3), 0.1, values=np.ones((2, 3, 4)), gradients=np.ones((2, 3, 4, 3)))
    np.testing.assert_allclose(grid_symmetry(thin).centre, [0.05, 0.1, 0.15])


def test_angles_about_an_axis_are_those_between_axes():
    """Against the least angle over many rotations about it."""
    axis = np.array([0.36, 0.48, 0.8])
    errors = rotation_vector(np.random.default_rng(0).normal(size=(20, 3)))
    cone = ObjectSymmetry(axis=axis)
    can = ObjectSymmetry(
        rotations=np.array([np.eye(3), half_turn(np.array([0.8, -0.6, 0.0]))]), axis=axis
    )
    about = turns_about(axis, 20_000)
    for each in (cone, can):
        all_of_them = (each.rotations[:, None] @ about).reshape(-1, 3, 3)
        traces = np.einsum("bij,sji->bs", errors, all_of_them)
        expected = np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)).min(axis=1)
        np.testing.assert_allclose(each.rotation_errors(errors), expected, atol=1e-3)


HALF = np.array([0.06, 0.09, 0.12])
QUICK = TruePoseSettings(
    rotations=100, cost=EvaluationCostSettings(lookup="trilinear", tolerance=0.005)
)


def test_the_true_pose_is_found_from_a_guess_some_centimetres_off():
    problem, truth = scene(np.random.default_rng(3), box(HALF, 0.01))
    stream = np.random.default_rng(0)
    sides = stream.uniform(-0.9, 0.9, (60, 3))
    axis = np.arange(60) % 3
    sign = np.where(np.arange(60) % 2, 1.0, -1.0)
    sides[np.arange(60), axis] = sign
    nodes = stream.uniform(-0.3, 0.3, (2000, 3))
    free = nodes[(np.abs(nodes) > HALF + 0.002).any(axis=1)]
    points = KnownPoints(free=apply(truth, free), known=apply(truth, sides * HALF))
    problem = replace(problem, points=points)
    turn = rotation_vector(np.array([0.02, -0.01, 0.015]))
    shift = np.array([0.05, -0.06, 0.03])
    guess = compose(turn @ truth[:3, :3], truth[:3, 3] + shift)
    found = find_true_pose(problem, guess, settings=QUICK)
    offset = found.world_from_object[:3, 3] - truth[:3, 3]
    assert np.sqrt((offset**2).sum()) < 0.004
    left = found.world_from_object[:3, :3] @ truth[:3, :3].T
    assert rotation_angle(left) < rotation_angle(turn)
    assert found.cost < 0.1 * found.guess_cost
    cost = EvaluationCost(problem, QUICK.cost)
    assert found.cost == cost.evaluate(inverse(found.world_from_object)[None])[0]
    assert find_true_pose(problem, guess, settings=replace(QUICK, passes=1)).cost >= found.cost


def test_every_pass_looks_closer(monkeypatch):
    """Reach becomes a spacing; spacing and angle shrink by their ratio, here to a quarter."""
    problem, truth = scene(np.random.default_rng(3), box(HALF))
    seen: list[PoseGrid] = []

    def watched(centre, offsets, rotations):
        seen.append(PoseGrid(centre, offsets, rotations=rotations))
        return seen[-1]

    monkeypatch.setattr(pose_scan, "PoseGrid", watched)
    settings = replace(QUICK, reach=0.08, spacing=0.02, rotations=400, angle=0.2, passes=3)
    best = find_true_pose(problem, truth, settings=replace(settings, passes=2)).world_from_object
    seen.clear()
    find_true_pose(problem, truth, settings=settings)
    np.testing.assert_array_equal(seen[2].centre, best[:3, 3])
    for grid, closer in zip(seen, (1.0, 0.25, 0.0625), strict=True):
        offsets = grid.offsets.points()
        assert np.abs(offsets).max() == pytest.approx(0.08 * closer)
        assert np.diff(np.unique(offsets[:, 2]))[0] == pytest.approx(0.02 * closer)
        angles = rotation_angle(grid.rotations[1:] @ grid.rotations[0].T)
        spread = np.sqrt((angles**2).mean())  # of three normal coordinates
        assert spread == pytest.approx(3.0**0.5 * 0.2 * closer, rel=0.1)


def test_a_guess_that_nothing_beats_stays():
    problem, truth = scene(np.random.default_rng(3), box(HALF))
    problem = replace(problem, points=KnownPoints(known=truth[None, :3, 3], known_sdf=[-0.06]))
    by = EvaluationCost(problem, QUICK.cost).evaluate(inverse(truth)[None])[0]
    found = find_true_pose(problem, truth, settings=QUICK)
    assert found.cost <= by == found.guess_cost


def test_what_cannot_be_searched_is_named():
    problem, _ = scene(np.random.default_rng(3), box(HALF))
    with pytest.raises(PoseError, match="guess"):
        find_true_pose(problem, np.ones((4, 4)))
    with pytest.raises(SettingError, match="the number of offsets is"):
        find_true_pose(problem, np.eye(4), settings=TruePoseSettings(spacing=0.001))
