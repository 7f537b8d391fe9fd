"""Depth images: pixels, regions, edges, rays, and cameras that are refused."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import maximum_filter, minimum_filter

from chsel.errors import SettingError
from chsel.problem.poses import axis_angle, compose
from chsel.sensing.depth_camera import (
    PinholeCamera,
    depth_regions,
    main_regions,
    occlusion_edges,
    pixel_normals,
    point_regions,
    speckle_free,
    valid_pixels,
)

CAMERA = PinholeCamera(4, 3, fx=2.0, fy=4.0, cx=1.0, cy=1.5)


def test_points_project_back_onto_their_pixels():
    depth = np.array([[1.0, 2.0, 3.0, 4.0], [0.5, 0.5, 0.5, 0.5], [1.0, 1.0, 1.0, 8.0]])
    points = CAMERA.back_project(depth)
    np.testing.assert_array_equal(points[2, 3], [8.0, 1.0, 8.0])
    u, v = 2.0 * points[..., 0] / points[..., 2] + 1.0, 4.0 * points[..., 1] / points[..., 2] + 1.5
    np.testing.assert_allclose([v, u], np.indices((3, 4)), atol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 3, 1.0, 1.0, 0.0, 0.0), "camera width is 0; accepted"),
        ((4, 3.5, 1.0, 1.0, 0.0, 0.0), "camera height is 3.5; accepted: a whole number"),
        ((4, 3, 1.0, 1.0, float("inf"), 0.0), "camera cx, cy are inf, 0.0; accepted: finite"),
    ],
)
def test_what_no_camera_has_is_refused(values, message):
    with pytest.raises(SettingError, match=message):
        PinholeCamera(*values)


WIDE = PinholeCamera(120, 90, fx=150.0, fy=160.0, cx=58.3, cy=46.1)
RAYS = WIDE.directions()
UPRIGHT = compose(axis_angle(np.array([0.6, 0.64, 0.48]), 0.9), np.array([0.01, -0.02, 0.4]))


def every_normal(depth, counts, reach):
    normals = np.zeros((*depth.shape, 3))
    pixels = np.argwhere(counts)
    found = pixel_normals(depth, counts, pixels=pixels, camera=WIDE, reach=reach)
    normals[tuple(pixels.T)] = found
    return normals, normals.any(axis=-1)


def angles(one, other):
    return 2.0 * np.arcsin(np.minimum(np.linalg.norm(one - other, axis=-1) / 2.0, 1.0))


@pytest.mark.parametrize("reach", [1, 2, 6])
def test_a_plane_has_its_normal_at_each_pixel_but_the_corners(reach):
    towards = np.array([0.3, -0.5, -0.8]) / np.sqrt(0.98)
    depth = -0.4 / (RAYS @ towards)
    counts = np.ones(depth.shape, dtype=bool)
    counts[20:50, 30] = False
    normals, given = every_normal(depth, counts, reach)
    assert given[reach:-reach, 35:-reach].all()
    assert given[counts].mean() > 0.97
    assert not given[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    np.testing.assert_allclose(normals[given], np.tile(towards, (given.sum(), 1)), atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(normals[given], axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("reach", [1, 3])
def test_the_normals_of_a_ball_are_those_of_its_surface(reach):
    """A ball of 60 mm at 0.4 m, of 2.6 mm a pixel, as of the intersection of rays with it."""
    centre, radius = np.array([0.02, -0.03, 0.4]), 0.06
    along = RAYS @ centre
    squared = (RAYS**2).sum(axis=-1)
    root = along**2 - squared * (centre @ centre - radius**2)
    hit = root > 0.0
    depth = np.where(hit, (along - np.sqrt(np.maximum(root, 0.0))) / squared, 0.7)
    true = (RAYS * depth[..., None] - centre) / radius
    normals, given = every_normal(depth, hit, reach)
    facing = -(true * RAYS).sum(axis=-1) / np.sqrt(squared)  # cosine of the angle to the ray
    middle = hit & (facing > 0.5)
    assert given[middle].mean() > 0.98
    assert angles(normals, true)[given & middle].max() < 0.08
    assert angles(normals, true)[given & hit & (facing > 0.8)].max() < 0.02
    assert angles(normals, true)[given & hit].max() < 0.35


@pytest.mark.parametrize("reach", [1, 2, 4])
def test_a_box_has_the_normals_of_its_faces_and_none_across_its_edges(reach):
    """The box of the mesh, by slabs; an edge is where another face is within reach."""
    mesh = trimesh.creation.box((0.12, 0.08, 0.2))
    half = 0.5 * mesh.extents
    rotation = UPRIGHT[:3, :3]
    origin = -UPRIGHT[:3, 3] @ rotation
    ends = (np.array([-half, half])[:, None, None] - origin) / (RAYS @ rotation)
    enters = ends.min(axis=0)
    depth = enters.max(axis=-1)
    hit = (depth < ends.max(axis=0).min(axis=-1)) & (depth > 0.0)
    axis = enters.argmax(axis=-1)
    sides = np.sign(RAYS @ rotation)
    local = -np.take_along_axis(sides, axis[..., None], axis=-1) * np.eye(3)[axis]
    points = (RAYS * depth[..., None])[hit] @ rotation + origin
    _, away, face = mesh.nearest.on_surface(points)
    assert away.max() < 1e-9
    inner = np.sort(np.abs(points) / half, axis=1)[:, 1] < 0.99  # on a single face
    np.testing.assert_allclose(mesh.face_normals[face][inner], local[hit][inner], atol=1e-9)
    normals, given = every_normal(depth, hit, reach)
    true = local @ rotation.T
    alone = hit & (minimum_filter(np.where(hit, axis, -1), 2 * reach + 1) == axis)
    alone &= maximum_filter(np.where(hit, axis, 9), 2 * reach + 1) == axis
    assert len(np.unique(axis[hit])) == 3
    assert given[alone].all()
    assert angles(normals, true)[alone].max() < 1e-7
    edges = hit & ~alone
    assert angles(normals, true)[edges & given].max() < 0.3
    assert 0.1 < given[edges].mean() < 0.9


@pytest.mark.parametrize("step", [0.004, 0.01, 0.015, 0.1])
@pytest.mark.parametrize("reach", [1, 3])
def test_no_normal_is_across_a_jump_of_depth(step, reach):
    """Two walls, both looking at the camera, of which one is behind the other."""
    depth = np.full((90, 120), 0.4)
    depth[:, 50:] += step
    counts = np.ones(depth.shape, dtype=bool)
    normals, given = every_normal(depth, counts, reach)
    true = np.broadcast_to([0.0, 0.0, -1.0], normals.shape)
    assert given[reach:-reach, np.r_[reach : 50 - 2 * reach, 50 + 2 * reach : 110]].all()
    assert angles(normals, true)[given].max() < 0.25
    if step > 0.012:  # more than a steep surface has: each side has its own normals
        assert angles(normals, true)[given].max() < 1e-9
        assert given[reach:-reach, reach:-reach].all()


def test_normals_of_noisy_depths_are_as_good_as_their_window_allows():
    """Of a plane: about each axis sigma / sqrt(S), S being the sum of squared offsets in metres."""
    random = np.random.default_rng(0)
    depth = 0.4 + random.normal(0.0, 0.001, (90, 120))
    counts = np.ones(depth.shape, dtype=bool)
    normals, given = every_normal(depth, counts, 4)
    pixel = 0.4 / 155.0
    expected = np.sqrt(2.0) * 0.001 / (pixel * np.sqrt(9 * 60.0))  # 9 rows of 2 (1 + 4 + 9 + 16)
    inner = given[4:-4, 4:-4]
    assert inner.all()
    off = angles(normals, np.array([0.0, 0.0, -1.0]))[4:-4, 4:-4]
    assert np.sqrt((off**2).mean()) == pytest.approx(expected, rel=0.1)


def test_only_depths_within_the_range_are_valid():
    depth = np.array([0.0, -1.0, np.nan, np.inf, -np.inf, 0.19, 0.2, 1.0, 5.0, 5.1])
    valid = valid_pixels(depth, nearest=0.2, furthest=5.0)
    assert valid.tolist() == [False] * 6 + [True] * 3 + [False]
    assert not valid_pixels(np.array([0.0, np.inf]), nearest=0.0, furthest=np.inf).any()


def test_edges_are_both_sides_of_every_jump_between_valid_neighbours():
    stream = np.random.default_rng(0)
    depth = np.where(stream.random((12, 15)) < 0.1, 1.0, 0.5) + stream.uniform(0.0, 0.02, (12, 15))
    depth[stream.random(depth.shape) < 0.2] = np.nan
    valid = np.isfinite(depth) & (stream.random(depth.shape) < 0.9)
    edges = occlusion_edges(depth, valid, jump=0.05)
    assert 0 < edges.sum() < valid.sum()
    for row, column in np.ndindex(depth.shape):
        around = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        jumps = np.abs(depth[around] - depth[row, column])[valid[around]]
        expected = valid[row, column] and bool((jumps > 0.05).any())
        assert edges[row, column] == expected


def test_a_longer_reach_looks_across_a_gap():
    depth = np.full((5, 9), 0.5)
    depth[:, 5:] = 1.0
    valid = np.ones(depth.shape, dtype=bool)
    valid[:, 4] = False
    assert not occlusion_edges(depth, valid, jump=0.05).any()
    across = occlusion_edges(depth, valid, jump=0.05, reach=2)
    np.testing.assert_array_equal(np.flatnonzero(across.any(axis=0)), [3, 5])


TELE = PinholeCamera(60, 40, fx=600.0, fy=600.0, cx=29.5, cy=19.5)


def regions(depth, jump=0.01, *, camera=TELE):
    return depth_regions(depth, depth > 0.0, camera=camera, jump=jump)


def test_regions_end_where_depth_jumps_and_the_threshold_grows_with_depth():
    depth = np.full((40, 60), 0.6)
    depth[:, 30:] += 0.015  # 2.5 % at 0.6 m; 1 % and the slant explain 1.67 %
    found = regions(depth)
    assert np.unique(found[:, :30]).tolist() == [1]
    assert np.unique(found[:, 30:]).tolist() == [2]
    depth = np.full((40, 60), 3.0)
    depth[:, 30:] += 0.045  # 1.5 % at 3 m
    assert regions(depth).max() == 1
    assert regions(depth, jump=0.005).max() == 2
    assert (
        regions(
            depth, jump=0.005, camera=PinholeCamera(60, 40, fx=300, fy=300, cx=29.5, cy=19.5)
        ).max()
        == 1
    )


def test_a_steeply_inclined_surface_is_one_region():
    slope = np.tan(np.radians(75.0))
    depth = 0.6 / (1.0 - slope * TELE.columns)[None].repeat(40, axis=0)
    assert np.abs(np.diff(depth, axis=1)).max() > 0.0035
    assert regions(depth, jump=0.001).max() == 1


def test_pixels_that_do_not_count_are_in_no_region_and_connect_none():
    depth = np.full((40, 60), 0.6)
    depth[20], depth[5, 5] = 0.0, np.nan
    found = depth_regions(depth, np.isfinite(depth) & (depth > 0.0), camera=TELE, jump=0.01)
    assert found[5, 5] == 0
    assert (found[20] == 0).all()
    assert (found[19, 0], found[21, 0], found.max()) == (1, 2, 2)
    depth[20, 7] = 0.6  # a bridge
    assert regions(np.nan_to_num(depth)).max() == 1
    diagonal = np.eye(3) * 0.5
    assert regions(diagonal, camera=PinholeCamera(3, 3, fx=9.0, fy=9.0, cx=1.0, cy=1.0)).max() == 3


@pytest.mark.parametrize("side", [1, 9])
def test_rays_of_small_regions_end_at_the_least_depth_around(side):
    depth = np.full((40, 60), 0.6)
    depth[10 : 10 + side, 20 : 20 + side] = 0.9
    ends, small = speckle_free(depth, depth > 0.0, regions=regions(depth), least=100)
    assert small == side**2
    np.testing.assert_array_equal(ends, np.full((40, 60), 0.6))
    depth[30, 30] = 0.4  # ends at itself
    ends, small = speckle_free(depth, depth > 0.0, regions=regions(depth), least=100)
    assert (small, ends[30, 30], ends[30, 31]) == (side**2 + 1, 0.4, 0.6)
    assert speckle_free(depth, depth > 0.0, regions=regions(depth), least=0)[1] == 0


def surface(count, size, *, centre):
    """Random points on a square (count, 3)."""
    plane = np.random.default_rng(count).uniform(-0.5, 0.5, (count, 2)) * size
    return np.pad(plane, ((0, 0), (0, 1))) + centre


def test_points_are_one_region_up_to_the_gap_and_others_beyond():
    one, other = surface(2000, 0.1, centre=(0, 0, 0)), surface(300, 0.03, centre=(0.2, 0, 0))
    found = point_regions(np.concatenate([one, other]), 0.02)
    assert (np.unique(found[:2000]).tolist(), np.unique(found[2000:]).tolist()) == ([1], [2])
    near = other - [0.2 - 0.05 - 0.015 - 0.015, 0.0, 0.0]  # 15 mm aside of the first
    assert point_regions(np.concatenate([one, near]), 0.02).max() == 1


def test_sparse_points_are_one_region_whatever_the_gap():
    sparse = surface(400, 1.0, centre=(0, 0, 0))  # about 25 mm apart
    assert np.bincount(point_regions(sparse, 0.001))[1:].max() > 390
    touches = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    assert point_regions(touches, 0.02).tolist() == [1, 1, 1]
    assert point_regions(np.concatenate([touches, [[5.0, 0, 0]]]), 0.02).max() == 2
    assert point_regions(np.zeros((0, 3)), 0.02).tolist() == []
    assert point_regions(np.zeros((5, 3)), 0.02).tolist() == [1] * 5


@pytest.mark.parametrize(
    ("sizes", "centres", "kept", "small", "far"),
    [
        ([100, 4], [0.0, 0.0], [True, False], 4, 0),
        ([100, 5], [0.0, 0.0], [True, True], 0, 0),
        ([40, 100], [0.0, 0.31], [False, True], 0, 40),
        ([40, 100], [0.0, 0.29], [True, True], 0, 0),
        ([1, 1, 1], [0.0, 0.1, 0.2], [True] * 3, 0, 0),
    ],
)
def test_the_largest_region_is_kept_and_large_ones_within_the_objects_diameter(
    sizes, centres, kept, small, far
):
    regions = np.repeat(np.arange(len(sizes)) + 1, sizes)
    points = np.zeros((len(regions), 3))
    points[:, 2] = np.repeat(centres, sizes)
    found = main_regions(regions, part=0.05, points=points, diameter=0.3)
    np.testing.assert_array_equal(found.kept, np.repeat(kept, sizes))
    assert (found.small, found.far) == (small, far)
    assert main_regions(regions, part=0.0).kept.all()
