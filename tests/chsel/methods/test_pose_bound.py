"""How far poses are from the best, but for symmetries of the object."""

import math

import numpy as np
import pytest
import trimesh

import chsel
from chsel.methods import build_method
from chsel.methods.anchored.pose_bound import pose_bound
from chsel.problem.poses import Poses, axis_angle, compose, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import StreamKey
from chsel.session.judging import trust_by
from tests.chsel.samples import hypotheses_at

DEGREE = math.radians(1.0)
X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
PLACE = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.7)), np.array([0.3, 0.2, 0.1]))
BOX = trimesh.creation.box((0.1, 0.06, 0.16))
CAN = trimesh.creation.cylinder(0.04, 0.12, sections=64)
WEDGE = trimesh.convex.convex_hull([[0, 0, 0], [0.1, 0, 0], [0, 0.06, 0], [0, 0, 0.16]])


def turned(*turns, shift=(0.0, 0.0, 0.0)):
    """A motion of the object in its frame: turns (axis, degrees), the first one first."""
    rotation = np.eye(3)
    for axis, degrees in turns:
        rotation = axis_angle(axis, np.array(degrees * DEGREE)) @ rotation
    return compose(rotation, np.array(shift))


def bound(mesh, *motions):
    """Of the mesh at PLACE, and after motions about its centre; millimetres and degrees."""
    centred = mesh.copy()
    centred.apply_translation(-mesh.center_mass)
    sdf = chsel.SdfGrid.from_mesh(centred, 0.004)
    world_from_object = np.array([PLACE, *(PLACE @ motion for motion in motions)])
    away, angle = pose_bound(sdf, Poses.of(inverse(world_from_object)))
    return 1000.0 * away, angle / DEGREE


def test_a_single_pose_is_off_by_nothing():
    assert bound(BOX) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("mesh", "turns", "left"),
    [
        (WEDGE, [(X, 2.0)], 2.0),
        (WEDGE, [(Z, 25.0)], 25.0),
        (WEDGE, [(X, 180.0)], 180.0),  # no symmetry
        (BOX, [(Z, 12.0)], 12.0),
        (BOX, [(Z, 180.0), (X, 6.0)], 6.0),
        (BOX, [(Z, 90.0)], 90.0),
        (CAN, [(Z, 130.0)], 0.0),
        (CAN, [(Z, 20.0)], 0.0),
        (CAN, [(Z, 77.0), (X, 7.0)], 7.0),
        (CAN, [(X, 180.0), (Z, 40.0), (X, 4.0)], 4.0),
    ],
)
def test_a_turn_counts_as_far_as_no_symmetry_undoes_it(mesh, turns, left):
    away, angle = bound(mesh, turned(*turns))
    assert angle == pytest.approx(left, abs=0.8)
    assert away < 0.6  # the centre stays


def test_the_farthest_pose_counts():
    shifts = [turned(shift=(0.001 * n, 0.0, 0.0)) for n in range(1, 4)]
    away, angle = bound(BOX, *shifts, turned((X, 3.0)))
    assert (away, angle) == (pytest.approx(3.0, abs=0.01), pytest.approx(3.0, abs=0.01))


def test_trust_has_the_bound_of_the_poses_that_explain_the_points_and_of_rivals():
    sdf = chsel.SdfGrid.from_mesh(BOX, 0.004)
    surface = trimesh.sample.sample_surface(BOX, 8, seed=3)[0] @ PLACE[:3, :3].T + PLACE[:3, 3]
    room = chsel.Workspace((-1, -1, -1), (1, 1, 1))
    points = chsel.KnownPoints(known=surface)
    posed = RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=np.eye(4)[None],
        workspace=room,
        free_resolution=0.01,
        key=StreamKey(0, 0),
    )
    far = PLACE @ turned(shift=(0.05, 0.0, 0.0))
    near = PLACE @ turned(shift=(0.0005, 0.0, 0.0))
    found = hypotheses_at(inverse(np.array([PLACE, near, far])))
    trust = trust_by(build_method("icp"), posed, hypotheses=found)
    assert trust.centre_within < 0.045  # not of the pose 50 mm away, which explains nothing
    assert trust.centre_within >= 0.0005 - 1e-9
    assert trust.numbers["centre_within"] == trust.centre_within
