"""Whether the best hypothesis can be moved without its points becoming unlikely."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.problem.noise import noise_model
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import StreamKey
from chsel.problem.trust import can_be_moved, pose_energies
from tests.chsel.samples import plain_energies

BOX = trimesh.creation.box((0.1, 0.06, 0.16))
CAN = trimesh.creation.cylinder(0.04, 0.12, sections=64)
POSE = compose(
    axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.7)), np.array([0.3, 0.2, 0.1])
)  # world_from_object
BEST = Poses.of(inverse(POSE[None]))
SIGMA, DISTANCE = 0.001, 0.006


def touched(mesh, **points):
    """By points in the object's frame."""
    known = chsel.KnownPoints(**{name: apply(POSE, group) for name, group in points.items()})
    sdf, room = chsel.SdfGrid.from_mesh(mesh, 0.004), chsel.Workspace((-1, -1, -1), (1, 1, 1))
    return RegistrationProblem(sdf, known, BEST.matrices, room, 0.01, StreamKey(0, 0))


def movable(mesh, sigma=SIGMA, **points):
    return can_be_moved(touched(mesh, **points), BEST, sigma, DISTANCE)


def on(mesh, count):
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])


def on_sides():
    """Contacts on the four long sides of the box, not near its ends."""
    points = on(BOX, 80)
    return points[np.abs(points[:, 2]) < 0.06]


@pytest.mark.parametrize("mesh", [BOX, CAN])
def test_contacts_all_around_hold_an_object_and_a_turn_of_a_can_is_no_motion(mesh):
    assert not movable(mesh, known=on(mesh, 40))
    assert movable(mesh, known=on(mesh, 4))
    assert movable(mesh, sigma=0.03, known=on(mesh, 40))  # far more than the distance


def test_an_object_slides_along_the_sides_that_were_touched():
    """By 14 mm, which moves the two ends by it and all else within itself: 6 mm on average."""
    sides = on_sides()
    assert movable(BOX, known=sides)
    ends = np.array([[0.0, 0.0, 0.08], [0.02, 0.01, 0.08], [0.0, 0.0, -0.08]])
    assert not movable(BOX, known=np.concatenate([sides, ends]))


def test_free_space_holds_an_object_too():
    sides = on_sides()
    x, y = np.meshgrid(np.arange(-0.05, 0.051, 0.01), np.arange(-0.03, 0.031, 0.01))
    beyond = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.083)], axis=1)
    assert movable(BOX, known=sides, free=beyond)  # the other way
    assert not movable(BOX, known=sides, free=np.concatenate([beyond, -beyond]))


def test_nothing_known_nearby_holds_nothing():
    assert movable(BOX, free=np.full((3, 3), 0.5))


@pytest.mark.parametrize("contacts", [5, 40])
def test_energies_of_poses_are_the_plain_formula(contacts):
    random = np.random.default_rng(contacts)
    problem = touched(
        BOX,
        known=on(BOX, contacts),
        free=on(BOX, 30) * random.uniform(0.8, 1.2, (30, 1)),
        occupied=on(BOX, 9) * random.uniform(0.9, 1.1, (9, 1)),
    )
    turns = axis_angle(np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.05, 0.5]))
    poses = Poses.of(inverse(POSE @ compose(turns, random.normal(0.0, 0.01, (3, 3)))))
    noise = noise_model(SIGMA)
    expected = plain_energies(noise, problem.sdf, problem.points, poses)
    np.testing.assert_allclose(pose_energies(problem, poses, noise), expected, rtol=1e-9)
