"""Contacts of a soft membrane with a camera behind it, and of a body by the force on it."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from chsel.errors import PointsError
from chsel.problem.poses import roll_pitch_yaw
from chsel.problem.streams import Purpose, StreamKey
from chsel.sensing.contact_sensing import (
    contact_ahead,
    contact_mask,
    contact_on_axis,
    contact_subset,
    deformation,
    share,
    smooth,
)
from chsel.sensing.depth_camera import PinholeCamera

CAMERA = PinholeCamera(224, 171, fx=200.0, fy=200.0, cx=112.0, cy=85.0)
MEMBRANE, RADIUS, PRESSED = 0.10, 0.03, 0.008  # m: its depth; of a sphere; how deep it is pressed
CENTRE = np.array([0.006, -0.004, MEMBRANE + RADIUS - PRESSED])


def test_a_sphere_is_touched_where_it_has_pressed_far_enough():
    ways = CAMERA.directions()
    a, b = (ways**2).sum(axis=-1), (ways * CENTRE).sum(axis=-1)
    rest = b**2 - a * (CENTRE @ CENTRE - RADIUS**2)
    first = np.where(rest >= 0.0, (b - np.sqrt(np.maximum(rest, 0.0))) / a, np.inf)
    pressed = np.minimum(first, MEMBRANE)  # a flat membrane that lies on the sphere
    imprint = deformation(np.full(pressed.shape, MEMBRANE), pressed)
    assert imprint.max() == pytest.approx(PRESSED, abs=1e-4)
    mask = contact_mask(smooth(imprint, 10), quantile=0.9, threshold=0.004)
    points = CAMERA.back_project(pressed)[mask]
    assert np.abs(np.sqrt(((points - CENTRE) ** 2).sum(axis=1)) - RADIUS).max() < 1e-9
    assert points[:, 2].max() < MEMBRANE - 0.003  # 4 mm, less what the filter spreads
    # The cap that is pressed in by more than 4 mm, as large as the camera sees it; it is less than
    # a tenth of the image.
    cap = np.pi * (RADIUS**2 - (RADIUS - PRESSED + 0.004) ** 2) * (CAMERA.fx / 0.096) ** 2
    assert mask.sum() == pytest.approx(cap, rel=0.05)
    np.testing.assert_allclose(points[:, :2].mean(axis=0), CENTRE[:2], atol=0.0005)
    mask = contact_mask(imprint, quantile=0.98, threshold=0.004)  # which bounds a larger contact
    assert mask.mean() == pytest.approx(0.02, abs=1e-3)
    assert imprint[mask].min() >= imprint[~mask].max()


def test_pixels_that_were_not_measured_are_not_deformed():
    reference = np.array([[0.1, 0.1, 0.0, np.nan, 0.1, 0.1]])
    depth = np.array([[0.08, np.nan, 0.08, 0.08, -1.0, 0.11]])
    expected = [[0.02, 0.0, 0.0, 0.0, 0.0, -0.01]]
    np.testing.assert_allclose(deformation(reference, depth), expected, atol=1e-15)
    valid = np.array([[False, True, True, True, True, True]])
    assert deformation(reference, depth, valid=valid)[0, 0] == 0.0
    with pytest.raises(PointsError, match=r"shape \(2, 2\); accepted: \(1, 6\)"):
        deformation(np.ones((2, 2)), depth)


@pytest.mark.parametrize("side", [1, 3, 10])
def test_the_filter_is_the_mean_around_each_pixel_and_missing_ones_are_0(side):
    image = np.random.default_rng(0).uniform(0.0, 0.01, (12, 14))
    image[5, 5] = np.nan
    smoothed = smooth(image, side)
    reflected = np.pad(np.nan_to_num(image), 10, mode="symmetric")
    for row, column in ((0, 0), (5, 6), (11, 13), (2, 12)):
        top, left = row + 10 - side // 2, column + 10 - side // 2
        mean = reflected[top : top + side, left : left + side].mean()
        assert smoothed[row, column] == pytest.approx(mean, abs=1e-15)


def test_pixels_that_do_not_count_are_not_in_the_quantile_or_in_contact():
    imprint = np.arange(20.0).reshape(4, 5)
    mask = contact_mask(imprint, quantile=0.5, threshold=1.0, valid=imprint < 10.0)
    assert imprint[mask].tolist() == [5.0, 6.0, 7.0, 8.0, 9.0]
    mask = contact_mask(imprint, quantile=0.9, threshold=0.0, valid=imprint < 0.0)
    assert (mask.shape, mask.any()) == ((4, 5), False)


def test_subsets_are_ascending_seeded_and_all_alike():
    chosen, again = (
        contact_subset(200, 50, stream=StreamKey(3, 1).stream(Purpose.CONTACT_POINTS))
        for _ in range(2)
    )
    assert len(chosen) == 50
    assert (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(chosen, again)
    stream = np.random.default_rng(0)
    counts = sum(
        np.bincount(contact_subset(10, 3, stream=stream), minlength=10) for _ in range(2000)
    )
    assert np.abs(counts / 2000 - 0.3).max() < 0.05
    np.testing.assert_array_equal(contact_subset(4, 50, stream=stream), np.arange(4))


@given(st.lists(st.integers(0, 1000), max_size=5), st.integers(0, 200))
def test_shares_are_in_proportion_and_sum_up(counts, most):
    shares = share(counts, most)
    total = sum(counts)
    assert sum(shares) == min(most, total)
    for count, part in zip(counts, shares, strict=True):
        assert 0 <= part <= count
        assert total <= most or abs(part - count * most / total) < 1.0


def test_shares_by_hand():
    assert share([300, 100], 50) == [38, 12]  # 37.5 and 12.5: the first among equals
    assert share([1, 1, 98], 50) == [1, 0, 49]


BOX = np.asarray(trimesh.creation.box((0.04, 0.06, 0.1)).triangles)
SPHERE = trimesh.creation.icosphere(4, 0.05)


@pytest.mark.parametrize("seed", range(10))
def test_a_contact_is_found_from_its_force_and_torque(seed):
    stream = np.random.default_rng(seed)
    face = int(stream.integers(len(SPHERE.faces)))
    point, normal = SPHERE.triangles_center[face], SPHERE.face_normals[face]
    force = 7.0 * (-normal + 0.5 * stream.normal(size=3) / 3**0.5)  # inclined
    shift = stream.normal(size=3)  # the origin is not the centre
    torque = np.cross(point + shift, force)
    found = contact_on_axis(force, torque, triangles=np.asarray(SPHERE.triangles) + shift)
    np.testing.assert_allclose(found.point, point + shift, atol=1e-9)
    np.testing.assert_allclose(found.normal, normal, atol=1e-9)
    assert found.miss == 0.0


def test_of_overlapping_bodies_the_outer_surface_is_met():
    both = np.concatenate([BOX, BOX + np.array([0.01, 0.0, 0.0])])
    for force, x in (([3.0, 0, 0], -0.02), ([-3.0, 0, 0], 0.03)):
        found = contact_on_axis(np.array(force), np.zeros(3), triangles=both)
        np.testing.assert_allclose(found.point, [x, 0.0, 0.0], atol=1e-12)


def test_a_line_that_misses_gives_the_nearest_point_of_an_edge():
    force = np.array([-5.0, 0.0, 0.0])
    point = np.array([0.3, 0.034, 0.01])
    found = contact_on_axis(force, np.cross(point, force), triangles=BOX)
    assert found.miss == pytest.approx(0.004)
    np.testing.assert_allclose(found.point[1:], [0.03, 0.01], atol=1e-12)
    assert abs(found.point[0]) == pytest.approx(0.02)


def test_without_torque_the_foremost_part_against_the_force_is_touched():
    found = contact_ahead(np.array([0.0, 0.0, -2.0]), BOX)
    np.testing.assert_allclose(found.point, [0.0, 0.0, 0.05], atol=1e-12)
    np.testing.assert_allclose(found.normal, [0.0, 0.0, 1.0])
    turned = BOX @ roll_pitch_yaw(np.array([0.3, 0.2, 0.1])).T
    corner = contact_ahead(np.array([0.0, 0.0, -2.0]), turned).point
    np.testing.assert_allclose(corner[2], turned[..., 2].max(), atol=1e-12)


def test_forces_along_edges_and_through_corners_have_an_answer():
    for point in ([0.02, 0.03, 0.0], [0.02, 0.03, 0.05], [0.02, 0.0, 0.05]):
        for force in ([-1.0, 0, 0], [0, 0, -1.0], [-1.0, -1.0, -1.0]):
            found = contact_on_axis(np.array(force), np.cross(point, force), triangles=BOX)
            assert found.miss < 1e-9
            assert np.isfinite(found.normal).all()
