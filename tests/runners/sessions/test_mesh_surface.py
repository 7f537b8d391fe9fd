"""Normals where faces meet: of a surface, and of contacts with sharp edges and thin walls."""

import math

import numpy as np
import pytest

from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, axis_angle, compose, inverse, rotated
from runners.sessions.configurations import FITTED
from runners.sessions.faults import FaultSettings
from runners.sessions.kinematic import KinematicEngine
from runners.sessions.mesh_surface import MeshSurface
from runners.sessions.probing import open_probing
from runners.sessions.probing_hand import panda_hand
from runners.sessions.probing_settings import ProbingSettings
from tests.chsel.sharp_objects import SHARP_OBJECTS, box, face_normals_at

EDGE = np.array([0.04, 0.03, 0.01])  # of the box
TURNED = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 0.7), np.array([0.3, -0.1, 0.2]))


def test_a_point_on_an_edge_or_corner_has_the_normal_of_one_of_its_faces():
    surface = MeshSurface(box(), TURNED)
    off = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    distances, _, normals = surface.closest(apply(TURNED, EDGE + 1e-4 * off))
    normals = normals @ TURNED[:3, :3]
    np.testing.assert_allclose(np.abs(distances), 1e-4 * np.array([1, 1, math.sqrt(2), 1]))
    assert (np.abs(normals).max(axis=1) > 1.0 - 1e-9).all()  # an axis of the box, not between two
    assert (normals @ [1.0, 1.0, 0.0] > 1.0 - 1e-9).all()  # out of the two faces of this edge
    for corner in box().vertices:
        (normal,) = surface.closest(apply(TURNED, 1.01 * corner[None]))[2] @ TURNED[:3, :3]
        assert np.abs(normal).max() == pytest.approx(1.0)
        assert normal @ np.sign(corner) == pytest.approx(1.0)


def test_of_faces_that_meet_the_one_along_a_direction_is_chosen():
    surface = MeshSurface(box(), TURNED)
    (point,) = apply(TURNED, EDGE[None])
    for direction, expected in (
        ([1.0, 0.9, 0.0], [1.0, 0.0, 0.0]),
        ([0.9, 1.0, 0.0], [0.0, 1.0, 0.0]),
        ([-0.1, -1.0, 5.0], [1.0, 0.0, 0.0]),  # the top is not near
    ):
        found = surface.facing_normal(point, rotated(TURNED[:3, :3], np.array(direction)))
        np.testing.assert_allclose(found @ TURNED[:3, :3], expected, atol=1e-9)


def test_a_finger_that_meets_an_edge_reports_one_of_its_two_faces():
    tip = panda_hand().surface_points(0.001)
    y = float(tip[np.argmax(tip[:, 0]), 1])
    foremost = math.hypot(0.04, 0.03)
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), math.pi - math.atan2(0.03, 0.04))
    pose = compose(turn, np.array([0.1 + foremost, y, 0.2]))  # an edge of the box towards the hand
    engine = KinematicEngine(box(), pose, settings=ProbingSettings(), hand=panda_hand())
    touch = engine.advance(np.array([0.05, 0.0, 0.2]))
    assert abs(touch.contact[0] - 0.1) < 5e-4
    assert abs(touch.contact[1] - y) < 5e-4
    normal = touch.normal @ turn
    assert np.abs(normal).max() == pytest.approx(1.0)
    assert normal @ [1.0, 1.0, 0.0] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", ["kinematic", "simulated"])
@pytest.mark.parametrize("name", SHARP_OBJECTS)
def test_contacts_of_sharp_and_thin_objects_have_the_normal_of_a_face_there(kind, name):
    mesh = SHARP_OBJECTS[name]
    settings = ProbingSettings(faults=FaultSettings(normals=0.2), engine="mujoco")
    session = open_probing(kind, mesh, configuration_name=FITTED, settings=settings, seed=0)
    points = KnownPoints.joined([probe.new_points for probe in session.probes()])
    session.close()
    assert len(points.known) >= 20
    assert set(points.normal_noise) == {0.2}
    object_from_world = inverse(session.world_from_object)
    within = 2e-5 if kind == "kinematic" else 0.001  # m: the engine's contacts are less exact
    contacts = apply(object_from_world, points.known)
    normals = points.normals @ object_from_world[:3, :3].T
    for contact, normal in zip(contacts, normals, strict=True):
        there = face_normals_at(mesh, contact, within=within)
        assert np.abs(there - normal).max(axis=1).min() < 1e-6
    if name in ("box", "plate"):  # hands probe along x, and touch no face that looks away
        assert points.normals[:, 0].max() < 1e-6
