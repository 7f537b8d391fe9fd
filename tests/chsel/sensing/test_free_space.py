"""Free space: rays, points, views, and the way of solids."""

from fractions import Fraction

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import PointsError, PoseError, SettingError
from chsel.numerics.threads import threads
from chsel.problem.points import FreeVoxels, Lattice, Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse, rotated
from chsel.sensing.depth_camera import PinholeCamera
from chsel.sensing.free_space import (
    FreeGrid,
    MarkedVoxels,
    interior_lattice,
    mark_segments,
    poses_between,
)
from tests.chsel.samples import box_distance, random_poses

SPACING = 0.01
WORKSPACE = Workspace((0.7, -0.2, 0.31), (1.1, 0.2, 0.6))  # the cabinet's
CAMERA = PinholeCamera(64, 48, fx=60.0, fy=62.0, cx=31.2, cy=23.9)
LOOKING_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
TILTED = axis_angle(np.array([0.0, 1.0, 0.0]), 0.5) @ LOOKING_ALONG_X
POSE = compose(TILTED, np.array([0.35, 0.02, 0.8]))


def grid(views=1):
    return FreeGrid(WORKSPACE, SPACING, views=views)


def voxels(centres):
    indices = Lattice(WORKSPACE.lower, SPACING).voxels(centres)
    found = {tuple(index) for index in indices.tolist()}
    assert len(found) == len(centres)
    return found


def made_image():
    """Depths between 0.3 and 1.2 m, some of them missing, and what to use of them."""
    stream = np.random.default_rng(3)
    depth = stream.uniform(0.3, 1.2, (48, 64))
    for missing in (np.nan, np.inf, 0.0):
        depth[stream.random(depth.shape) < 0.05] = missing
    return depth, stream.random(depth.shape) < 0.8


DEPTH, MASK = made_image()


def test_a_ray_into_the_workspace_begins_at_its_border():
    free = grid()
    assert free.shape == (41, 41, 30)
    assert free.along_rays([-1.0, 0.0, 0.4], [[0.8, 0.0, 0.4]]) == 11
    assert free.along_rays([3.0, 0.0, 0.5], [[-3.0, 0.0, 0.5]]) == 41
    assert free.along_rays([3.0, 0.0, 0.5], [[1.2, 0.0, 0.5], [3.0, 9.0, 0.5]]) == 0


def test_random_rays_mark_what_they_meet_and_nothing_far_from_them():
    stream = np.random.default_rng(0)
    together = grid()
    every = set()
    origins, ends = stream.uniform([0.5, -0.4, 0.2], [1.3, 0.4, 0.8], (2, 40, 3))
    for a, b in zip(origins, ends, strict=True):
        free = grid()
        free.along_rays(a, b)
        centres = free.new()
        found = voxels(centres)
        every |= found

        samples = a + np.linspace(0.0, 1.0, 2001)[:, None] * (b - a)
        place = (samples - WORKSPACE.lower) / SPACING + 0.5
        clear = (np.abs(place - np.rint(place)) > 1e-9).all(axis=1)
        clear &= ((place > 0.0) & (place < free.shape)).all(axis=1)
        assert {tuple(index) for index in np.floor(place[clear]).astype(int).tolist()} <= found

        way = b - a
        along = np.clip((centres - a) @ way / (way @ way), 0.0, 1.0)
        off = centres - a - along[:, None] * way
        assert np.sqrt((off**2).sum(axis=1)).max(initial=0.0) <= np.sqrt(3.0) / 2.0 * SPACING
    together.along_rays(origins, ends)
    assert voxels(together.new()) == every


def test_points_are_in_the_voxels_of_the_lattice():
    stream = np.random.default_rng(2)
    points = stream.uniform([0.7, -0.2, 0.31], [1.1, 0.2, 0.6], (500, 3))
    points[:50] = np.rint(points[:50] * 200.0) / 200.0  # on faces, edges and corners
    free = grid()
    reference = FreeVoxels(Lattice(WORKSPACE.lower, SPACING))
    for half in (points[:300], points[200:]):
        free.at(half)
        np.testing.assert_array_equal(free.new(), reference.add(half))
    assert free.count == len(reference)
    assert free.new().shape == (0, 3)


def test_an_image_is_the_rays_of_its_pixels():
    by_image, by_rays = grid(), grid()
    fresh = by_image.from_depth(DEPTH, CAMERA, world_from_camera=POSE, mask=MASK, fraction=0.9)
    with np.errstate(invalid="ignore"):
        ends = rotated(POSE[:3, :3], CAMERA.back_project(0.9 * DEPTH)[MASK]) + POSE[:3, 3]
    assert by_rays.along_rays(POSE[:3, 3], ends) == fresh > 5000
    np.testing.assert_array_equal(by_image.new(), by_rays.new())


def test_the_number_of_threads_changes_nothing(monkeypatch):
    for name in ("_RAYS_PER_THREAD", "_POINTS_PER_THREAD"):
        monkeypatch.setattr(f"chsel.sensing.free_space.{name}", 1)
    found = []
    for count in (1, 2, 3):
        free = grid()
        with threads(count):
            free.from_depth(DEPTH, CAMERA, world_from_camera=POSE, mask=MASK)
            free.at(CAMERA.back_project(DEPTH)[MASK], poses=POSE)
        assert free.count > 5000
        found.append(free.new())
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_voxels_are_free_once_enough_views_saw_them():
    free = grid(views=3)
    eye = [0.0, 0.0, 0.4]
    near, far = [[0.8, 0.0, 0.4]] * 5, [[0.9, 0.0, 0.4]]
    assert [free.along_rays(eye, ends) for ends in (near, far, near)] == [0, 0, 11]
    assert len(free.new()) == 11
    assert [free.along_rays(eye, ends) for ends in (near, far, far)] == [0, 0, 10]
    assert free.at([0.9, 0.0, 0.4]) == 0
    assert free.at([1.0, 0.0, 0.4]) == 1
    assert len(free.new()) == free.count - 11 == 11


def test_sizes_shapes_and_poses_that_do_not_fit_are_refused():
    with pytest.raises(SettingError, match=r"0\.4 x 0\.4 x 0\.29 m .* 4\.644e\+10 .*200_000_000"):
        FreeGrid(WORKSPACE, 0.0001)
    with pytest.raises(SettingError, match="views is 251; accepted"):
        grid(views=251)
    free = grid()
    with pytest.raises(PointsError, match=r"depth has shape \(64, 48\); accepted: \(48, 64\)"):
        free.from_depth(DEPTH.T, CAMERA, world_from_camera=POSE, mask=MASK)
    with pytest.raises(PointsError, match=r"mask has shape \(48,\)"):
        free.from_depth(DEPTH, CAMERA, world_from_camera=POSE, mask=MASK[:, 0])
    with pytest.raises(PoseError, match="world_from_camera"):
        free.from_depth(DEPTH, CAMERA, world_from_camera=2.0 * POSE, mask=MASK)
    with pytest.raises(PointsError, match="origin has 2 points; accepted: 1, or 5"):
        free.along_rays(np.zeros((2, 3)), np.zeros((5, 3)))
    assert free.count == 0


COUNTS = (5, 4, 3)
LOWER = np.full(3, 0.5)  # so that voxel k is from k to k + 1
places = st.tuples(*[st.integers(-12, 32).map(lambda n: n / 4.0)] * 3)


def marked(a, b):
    met = np.zeros(COUNTS, dtype=np.uint8)
    grid = MarkedVoxels(met.reshape(-1), COUNTS, lower=LOWER, spacing=1.0)
    mark_segments(grid, np.array([a]), ends=np.array([b]), first=0, last=1)
    assert met.max() <= 1
    return {tuple(voxel) for voxel in np.argwhere(met).tolist()}


def overlap(voxel, a, *, b):
    """How much of the segment is in the voxel with its faces (below 0: none), and whether within
    it alone: not in a face that it shares with the next lower voxel.
    """
    enters = Fraction(0)
    leaves = Fraction(1)
    within = True
    for k, start, end in zip(voxel, map(Fraction, a), map(Fraction, b), strict=True):
        d = end - start
        if d == 0:
            if not k <= start <= k + 1:
                return Fraction(-1), False
            within &= start < k + 1
        else:
            crossings = sorted([(k - start) / d, (k + 1 - start) / d])
            enters, leaves = max(enters, crossings[0]), min(leaves, crossings[1])
    return leaves - enters, within


@settings(max_examples=150, deadline=None)
@given(a=places, b=places)
def test_all_voxels_that_are_passed_are_marked_and_joined_and_none_that_is_not_touched(a, b):
    found = marked(a, b)
    for voxel in np.ndindex(*COUNTS):
        inside, within = overlap(voxel, a, b=b)
        assert voxel in found or not (inside > 0 and within)
        assert voxel not in found or inside >= 0
    for end in (a, b):
        inside = all(0.0 < x < count for x, count in zip(end, COUNTS, strict=True))
        assert not inside or tuple(int(x) for x in end) in found
    sums = np.array(sorted(found)).reshape(-1, 3)
    order = np.argsort(sums @ np.sign(np.array(b) - np.array(a)), kind="stable")
    assert np.abs(np.diff(sums[order], axis=0)).max(initial=0) <= 1


BELOW = float(np.nextafter(2.0, 0.0))


@pytest.mark.parametrize(
    ("a", "b", "found"),
    [  # over edges and corners
        ((0.5, 0.5, 0.5), (2.5, 2.5, 2.5), {(0, 0, 0), (1, 1, 1), (2, 2, 2)}),
        # within a face: in the upper voxels, if there are some
        ((0.5, 2.0, 0.5), (2.5, 2.0, 0.5), {(0, 2, 0), (1, 2, 0), (2, 2, 0)}),
        ((0.5, 4.0, 0.5), (2.5, 4.0, 0.5), set()),
        # touched from outside
        ((-1.0, 1.0, 0.5), (1.0, -1.0, 0.5), set()),
        # next to faces, and of no size
        ((BELOW, 1.0, 1.0), (2.0, 1.0, 1.0), {(1, 1, 1), (2, 1, 1)}),
        ((0.0, 0.0, 0.0), (5e-324, -5e-324, 0.0), {(0, 0, 0)}),
        ((2.0, 2.0, 2.0), (2.0, 2.0, 2.0), {(2, 2, 2)}),
        ((-1e15, 0.5, 0.5), (1e15, 0.5, 0.5), {(i, 0, 0) for i in range(5)}),
    ],
)
def test_ways_on_borders_have_voxels_of_their_own(a, b, found):
    assert marked(a, b) == found


SIZE = np.array([0.10, 0.04, 0.06])
BOX = trimesh.creation.box(SIZE)
DIAGONAL = np.sqrt(3.0) * SPACING
AROUND = Workspace((-0.2, -0.2, -0.1), (0.3, 0.2, 0.1))


def turns(angles):
    return axis_angle(np.tile([0.0, 0.0, 1.0], (len(angles), 1)), angles)


def test_nodes_of_solids_are_around_their_middles_and_off_their_faces():
    nodes = interior_lattice(BOX.copy().apply_translation([0.3, 0.2, 0.1]), 0.01)
    assert len(nodes) == 9 * 3 * 5
    np.testing.assert_allclose(nodes.mean(axis=0), [0.3, 0.2, 0.1], atol=1e-12)
    assert (np.abs(nodes - [0.3, 0.2, 0.1]) < 0.5 * SIZE - 1e-3).all()
    plate = trimesh.creation.box((0.1, 0.1, 0.001))  # thin parts have nodes
    ball = trimesh.creation.icosphere(radius=0.03).apply_translation([0.5, 0.0, 0.0])
    assert len(interior_lattice(plate, 0.01)) == 81
    both = interior_lattice([plate, ball], 0.01)
    near_ball = np.sqrt(((both - [0.5, 0.0, 0.0]) ** 2).sum(axis=1)) < 0.03
    assert near_ball.sum() == 93  # whole numbers with i^2 + j^2 + k^2 < 9
    assert len(both) == 81 + near_ball.sum()
    assert interior_lattice([], 0.01).shape == (0, 3)
    with pytest.raises(SettingError, match=r"spacing is 1e-05 m.*2_000_000"):
        interior_lattice(BOX, 1e-5)


def test_nothing_moves_further_than_a_step_and_all_poses_lie_near_the_way():
    stream = np.random.default_rng(0)
    poses = random_poses(stream, 6, reach=0.2)
    way = poses_between(poses, step=0.005, radius=0.1)
    np.testing.assert_array_equal(way[[0, -1]], poses[[0, -1]])
    points = stream.normal(size=(50, 3))
    points *= 0.1 / np.sqrt((points**2).sum(axis=1, keepdims=True))
    moved = np.diff(apply(way, points), axis=0)
    longest = np.sqrt((moved**2).sum(axis=-1)).max()
    assert 0.003 < longest <= 0.005 + 1e-12
    for pose in poses:  # each of them is one of the way
        assert np.abs(way - pose).max(axis=(1, 2)).min() == 0.0


def test_poses_that_hardly_move_are_thinned():
    poses = np.tile(np.eye(4), (5001, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 0.1, 5001)
    way = poses_between(poses, step=0.01, radius=0.2)
    assert 11 <= len(way) <= 12
    assert np.diff(way[:, 0, 3]).max() <= 0.01 + 1e-12
    np.testing.assert_array_equal(way[[0, -1]], poses[[0, -1]])
    for count, left in ((100, 2), (1, 1), (0, 0)):
        assert len(poses_between(poses[:count], step=0.01, radius=0.2)) == left
    poses[-1, 0, 3] = 1e9
    with pytest.raises(PoseError, match=r"1e\+09 m.*accepted: at most 1_000_000"):
        poses_between(poses, step=0.005, radius=0.1)


@pytest.mark.parametrize("turned", [0.0, 3.0])
def test_a_box_that_moves_and_turns_frees_the_voxels_it_passes(turned):
    ends = np.array([[-0.1, 0.0, 0], [0.2, 0.05, 0]])
    given = compose(turns(np.array([0.2, 0.2 + turned])), ends)
    grid = FreeGrid(AROUND, SPACING)
    way = poses_between(given, step=0.005, radius=0.07)
    fresh = grid.at(interior_lattice(BOX, 0.005), poses=way)
    centres = grid.new()
    assert len(centres) == fresh

    s = np.linspace(0.0, 1.0, 301)
    dense = compose(turns(0.2 + s * turned), ends[0] + s[:, None] * (ends[1] - ends[0]))

    def distance(points):
        """Signed distance (N,) to the union of the box on its way, from outside exact."""
        return np.min([box_distance(apply(pose, points), SIZE) for pose in inverse(dense)], axis=0)

    assert distance(centres).max() <= 0.5 * DIAGONAL
    every = grid.lattice.centres(np.indices(grid.shape).reshape(3, -1).T)
    wholly = every[distance(every) < -0.5 * DIAGONAL]
    assert len(wholly) > 100
    grid.at(wholly)
    assert len(grid.new()) == 0  # all of them were free before
