"""Errors of poses modulo symmetries, and the hypothesis closest to the truth."""

import numpy as np
import pytest
import trimesh

from chsel.plausible.pose_metrics import closest_pose, pose_errors, result_numbers
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.points import KnownPoints
from chsel.problem.poses import axis_angle, compose, inverse, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from runners.objects.loader import load_model
from tests.chsel.plausible.scenes import WORKSPACE
from tests.chsel.samples import hypotheses_at

TRUTH = compose(rotation_vector(np.array([0.7, -0.4, 1.1])), np.array([0.3, -0.2, 0.9]))
CENTRE = np.array([0.4, -0.2, 0.6])  # far from the origin of the mesh
BOX = trimesh.creation.box((0.06, 0.16, 0.21))
BOX.apply_translation(CENTRE)
SYMMETRY = object_symmetry(BOX)
X, Y, Z = np.eye(3)


def about_centre(axis, angle, *, shift=None):
    """A rigid motion (4, 4) of the object in its own frame: a rotation about its centre."""
    rotation = axis_angle(axis, np.array(angle))
    shift = np.zeros(3) if shift is None else shift
    return compose(rotation, CENTRE - rotation @ CENTRE + shift)


def hypothesis(motion):
    """object_from_world (1, 4, 4) of the object moved before it is placed at the true pose."""
    return inverse(TRUTH @ motion)[None]


def test_errors_near_a_symmetric_pose_are_from_there():
    shift = np.array([0.003, 0.0, -0.004])
    tilt = about_centre(np.array([0.6, 0.8, 0.0]), 0.1, shift=shift)
    for motion in (tilt, tilt @ about_centre(Z, np.pi), about_centre(X, np.pi) @ tilt):
        position, rotation = pose_errors(hypothesis(motion), TRUTH, symmetry=SYMMETRY)
        np.testing.assert_allclose(position, 0.005, atol=1e-9)
        np.testing.assert_allclose(rotation, 0.1, atol=1e-6)


def test_a_mirror_image_is_not_a_symmetry():
    """Half a turn of a drill is an error."""
    drill = object_symmetry(load_model("drill"))
    turned = TRUTH @ compose(axis_angle(Z, np.array(np.pi)), np.zeros(3))
    _, rotation = pose_errors(inverse(turned)[None], TRUTH, symmetry=drill)
    assert rotation[0] == pytest.approx(np.pi)


def test_about_an_axis_of_revolution_any_angle_is_right():
    can = trimesh.creation.cylinder(0.033, 0.1)
    can.apply_translation(CENTRE)
    symmetry = object_symmetry(can)
    upside_down = about_centre(X, np.pi)
    poses = [about_centre(Z, 1.0), about_centre(Z, 2.5) @ upside_down]
    poses += [about_centre(Y, 0.2) @ about_centre(Z, 1.0), about_centre(Y, 3.0)]
    found = np.concatenate([hypothesis(pose) for pose in poses])
    position, rotation = pose_errors(found, TRUTH, symmetry=symmetry)
    np.testing.assert_allclose(position, 0.0, atol=1e-9)
    np.testing.assert_allclose(rotation, [0.0, 0.0, 0.2, np.pi - 3.0], atol=1e-6)


def test_numbers_of_a_result_are_modulo_symmetries_with_or_without_a_mesh():
    motions = [about_centre(Z, np.pi, shift=np.array([0.0, 0.02, 0.0])), about_centre(X, 0.5)]
    motions += [about_centre(X, np.deg2rad(3.0), shift=np.array([0.002, 0.0, 0.0]))]
    poses = np.concatenate([hypothesis(motion) for motion in motions])
    found = hypotheses_at(poses)
    sdf = SdfGrid.from_mesh(BOX, 0.01)
    points = KnownPoints(known=[[0.0, 0.0, 0.0]])
    problem = RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=poses,
        workspace=WORKSPACE,
        free_resolution=0.01,
        key=StreamKey(0, 1),
    )
    numbers = result_numbers(found, problem, world_from_object=TRUTH, symmetry=SYMMETRY)
    assert numbers["best_position_error"] == pytest.approx(0.02, abs=1e-9)
    assert numbers["best_rotation_error"] == pytest.approx(0.0, abs=1e-6)
    assert numbers["closest_position_error"] == pytest.approx(0.002, abs=1e-9)  # not the centre's
    assert numbers["closest_rotation_error"] == pytest.approx(np.deg2rad(3.0), abs=1e-6)
    without = result_numbers(found, problem, world_from_object=TRUTH, symmetry=None)
    assert without["best_position_error"] == pytest.approx(0.02, abs=0.005)
    assert without["best_rotation_error"] == pytest.approx(np.pi, abs=1e-6)
    assert "best_position_error" not in result_numbers(
        found, problem, world_from_object=None, symmetry=None
    )


def test_the_closest_pose_is_that_of_the_closest_surface():
    """Modulo symmetries, and whatever stands where no kernel can read."""
    sdf = SdfGrid.from_mesh(BOX, 0.01)
    motions = [about_centre(Z, 0.1), about_centre(Z, np.pi, shift=np.array([0.001, 0.0, 0.0]))]
    unreadable = np.diag([1.0, 1.0, 1.0, 1.0])[None] + np.array([[np.nan], [0], [0], [0]])
    poses = np.concatenate([unreadable, *(hypothesis(motion) for motion in motions)])
    assert closest_pose(poses, TRUTH, sdf=sdf) == 2
    assert closest_pose(poses[:2], TRUTH, sdf=sdf) == 1
    assert closest_pose(poses[:1], TRUTH, sdf=sdf) == 0
