"""Pose errors that are recorded and shown are modulo the object's symmetries, at its centre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.plausible.symmetry import object_symmetry
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import axis_angle, compose, inverse
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.comparing.comparison import numbers_under
from replay.events import Measured, ProblemPosed, SessionStarted
from replay.recorder import ListRecorder
from replay.registration import register_recorded, symmetry_for_errors
from replay.verbs.accept import best_pose_moves

CENTRE = np.array([0.3, -0.2, 0.25])
TRUTH = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.8)), np.array([0.1, 0.0, -0.3]))
WORKSPACE = Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.06, 0.1, 0.14))
    mesh.apply_translation(CENTRE)
    return mesh


def turned(degrees: float, shift: float = 0.0) -> np.ndarray:
    """object_from_world of the true pose turned about the box's z axis, and shifted along it."""
    rotation = axis_angle(np.array([0.0, 0.0, 1.0]), np.deg2rad(degrees))
    motion = compose(rotation, CENTRE - rotation @ CENTRE + [0.0, 0.0, shift])
    return inverse(TRUTH @ motion)


def found(*poses: np.ndarray) -> Hypotheses:
    count = len(poses)
    cost, duplicate = np.arange(float(count)), np.zeros(count, dtype=bool)
    poses = np.array(poses).reshape(-1, 4, 4)
    return Hypotheses(poses, cost, duplicate, np.full(count, -1), np.zeros((0, 4, 4)))


class Fixed:
    """A method that knows its result."""

    online = OnlineSettings()

    def __init__(self, hypotheses: Hypotheses) -> None:
        self.hypotheses = hypotheses

    def register(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        return self.hypotheses


@pytest.fixture(scope="module")
def start():
    mesh = box()
    return SessionStarted(
        runner="probe",
        object="box",
        session="points",
        method="fixed",
        seed=0,
        config={},
        mesh=mesh,
        sdf=SdfGrid.from_mesh(mesh, 0.01, padding=0.03),
        workspace=WORKSPACE,
        free_resolution=0.01,
        initial_points=KnownPoints(),
        world_from_object=TRUTH,
    )


def problem_of(start: SessionStarted) -> RegistrationProblem:
    points = KnownPoints(known=[[0.0, 0.0, 0.0]], known_sdf=[0.0])
    return RegistrationProblem(
        start.sdf, points, turned(0.0)[None], WORKSPACE, 0.01, StreamKey(0, 1)
    )


def test_recorded_errors(start):
    recorder, method = ListRecorder(), Fixed(found(turned(180.0, 0.03), turned(10.0)))
    posed = ProblemPosed(1, problem_of(start))
    registered = register_recorded(posed, method, recorder, TRUTH, symmetry_for_errors(start))
    (measured,) = (event for event in recorder.events if isinstance(event, Measured))
    assert measured.values == registered.numbers
    assert measured.values["best_position_error"] == pytest.approx(0.03, abs=1e-9)
    assert measured.values["best_rotation_error"] == pytest.approx(0.0, abs=1e-6)
    assert measured.values["closest_position_error"] == pytest.approx(0.0, abs=1e-9)
    assert measured.values["closest_rotation_error"] == pytest.approx(np.deg2rad(10.0), abs=1e-6)


def test_compared_errors(start):
    class ByOrder:
        def evaluate(self, poses: np.ndarray) -> np.ndarray:
            return np.arange(float(len(poses)))

    numbers = numbers_under(ByOrder(), found(turned(170.0), turned(90.0)), start)
    assert numbers["best_position_error"] == pytest.approx(0.0, abs=1e-9)
    assert numbers["best_rotation_error"] == pytest.approx(np.deg2rad(10.0), abs=1e-6)


def test_how_far_the_best_pose_moves(start):
    symmetry = object_symmetry(start.mesh)
    pair = found(turned(180.0)), found(turned(20.0, 0.004))
    position, rotation = best_pose_moves(*pair, symmetry)
    assert position == pytest.approx(0.004, abs=1e-9)
    assert rotation == pytest.approx(np.deg2rad(20.0), abs=1e-6)
    assert np.isnan(best_pose_moves(pair[0], found(), symmetry)).all()
    assert np.isnan(best_pose_moves(found(), pair[0], symmetry)).all()


def test_without_a_true_pose_no_symmetry_is_sought(start):
    assert symmetry_for_errors(start) is object_symmetry(start.mesh)
    assert symmetry_for_errors(replace(start, world_from_object=None)) is None
