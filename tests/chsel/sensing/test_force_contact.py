from __future__ import annotations

import numpy as np
import pytest
import trimesh

from chsel.problem.poses import roll_pitch_yaw
from chsel.sensing.contact_sensing import contact_ahead, contact_on_axis

BOX = np.asarray(trimesh.creation.box((0.04, 0.06, 0.1)).triangles)
SPHERE = trimesh.creation.icosphere(4, 0.05)


@pytest.mark.parametrize("seed", range(20))
def test_a_contact_is_found_from_its_force_and_torque(seed: int) -> None:
    stream = np.random.default_rng(seed)
    face = int(stream.integers(len(SPHERE.faces)))
    point = SPHERE.triangles_center[face]
    inclined = -SPHERE.face_normals[face] + 0.5 * stream.normal(size=3) / 3**0.5
    force = 7.0 * inclined
    shift = stream.normal(size=3)  # the origin is not the centre
    found = contact_on_axis(
        force, np.cross(point + shift, force), np.asarray(SPHERE.triangles) + shift
    )
    np.testing.assert_allclose(found.point, point + shift, atol=1e-9)
    np.testing.assert_allclose(found.normal, SPHERE.face_normals[face], atol=1e-9)
    assert found.miss == 0.0


def test_of_overlapping_bodies_the_outer_surface_is_met() -> None:
    both = np.concatenate([BOX, BOX + np.array([0.01, 0.0, 0.0])])
    for force, x in (([3.0, 0, 0], -0.02), ([-3.0, 0, 0], 0.03)):
        found = contact_on_axis(np.array(force), np.zeros(3), both)
        np.testing.assert_allclose(found.point, [x, 0.0, 0.0], atol=1e-12)


def test_a_line_that_misses_gives_the_nearest_point_of_an_edge() -> None:
    force, point = np.array([-5.0, 0.0, 0.0]), np.array([0.3, 0.034, 0.01])
    found = contact_on_axis(force, np.cross(point, force), BOX)
    assert found.miss == pytest.approx(0.004)
    np.testing.assert_allclose(found.point[1:], [0.03, 0.01], atol=1e-12)
    assert abs(found.point[0]) == pytest.approx(0.02)


def test_without_torque_the_foremost_part_against_the_force_is_touched() -> None:
    found = contact_ahead(np.array([0.0, 0.0, -2.0]), BOX)
    np.testing.assert_allclose(found.point, [0.0, 0.0, 0.05], atol=1e-12)
    np.testing.assert_allclose(found.normal, [0.0, 0.0, 1.0])
    turned = BOX @ roll_pitch_yaw(np.array([0.3, 0.2, 0.1])).T
    corner = contact_ahead(np.array([0.0, 0.0, -2.0]), turned).point
    np.testing.assert_allclose(corner[2], turned[..., 2].max(), atol=1e-12)


def test_forces_along_edges_and_through_corners_have_an_answer() -> None:
    for point in ([0.02, 0.03, 0.0], [0.02, 0.03, 0.05], [0.02, 0.0, 0.05]):
        for force in ([-1.0, 0, 0], [0, 0, -1.0], [-1.0, -1.0, -1.0]):
            at, push = np.array(point), np.array(force)
            found = contact_on_axis(push, np.cross(at, push), BOX)
            assert found.miss < 1e-9
            assert np.isfinite(found.normal).all()
