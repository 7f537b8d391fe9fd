"""E_0 and E_l by the result before: laws of the noise, uniform starts, and which set is kept."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, SdfGrid, Workspace
from chsel.problem.initial_sets import (
    OnlineSettings,
    first_initial_set,
    updated_initial_set,
)
from chsel.problem.poses import axis_angle, compose, inverse, rotation_angle
from chsel.problem.streams import StreamKey
from tests.chsel.samples import hypotheses_at, pose_problem

GRID = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
WORKSPACE = Workspace((-0.1, -0.3, 0.0), (0.5, 0.3, 0.6))
POINTS = KnownPoints(known=[[0.0, 0.0, 0.1]])
KEY = StreamKey(5, 2)
MANY = 100_000
TURNS = axis_angle(np.tile([0.0, 0.6, 0.8], (3, 1)), np.linspace(0.1, 2.0, 3))
POSES = compose(TURNS, np.linspace(0.0, 0.3, 9).reshape(3, 3))
RESULT = replace(hypotheses_at(POSES), elites=np.concatenate([POSES, inverse(POSES)]))


def test_first_of_the_updated_set_is_the_best_pose_to_the_bit():
    updated = updated_initial_set(RESULT, KEY, settings=OnlineSettings())
    assert updated[0].tobytes() == POSES[0].tobytes()
    assert not (updated[1:] == updated[0]).all(axis=(1, 2)).any()


@pytest.mark.parametrize(
    ("law", "angle_rms"), [("axis_gauss", 0.3), ("rotvec_gauss", 0.3 * np.sqrt(3))]
)
def test_update_noise_has_the_set_deviations_and_its_axes_are_uniform_on_the_sphere(law, angle_rms):
    settings = OnlineSettings(hypotheses=MANY, rotation_law=law, keep_best=False)
    world = inverse(updated_initial_set(RESULT, KEY, settings=settings))
    best = inverse(POSES[0])
    deviation = (world[:, :3, 3] - best[:3, 3]).std(axis=0)
    np.testing.assert_allclose(deviation, 0.05, rtol=0.01)
    turn = world[:, :3, :3] @ best[:3, :3].T
    assert np.sqrt((rotation_angle(turn) ** 2).mean()) == pytest.approx(angle_rms, rel=0.02)
    skew = turn - np.swapaxes(turn, 1, 2)
    vector = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    axis = vector / np.sqrt((vector**2).sum(axis=0))
    np.testing.assert_allclose(np.cov(axis), np.eye(3) / 3, atol=0.01)


def first_set(points=None, **changes):
    settings = OnlineSettings(**changes)
    return inverse(
        first_initial_set(WORKSPACE, points or KnownPoints(), key=KEY, settings=settings)
    )


def test_first_set_is_uniform_in_workspace_and_rotations():
    world = first_set(hypotheses=MANY)
    (lower, upper) = WORKSPACE.bounds
    places = world[:, :3, 3]
    assert (places >= lower).all()
    assert (places <= upper).all()
    np.testing.assert_allclose(places.mean(axis=0), (lower + upper) / 2, atol=0.005)
    np.testing.assert_allclose(places.std(axis=0), (upper - lower) / np.sqrt(12), rtol=0.02)
    # Uniform on SO(3): every column is uniform on the sphere, and E[angle] = pi/2 + 2/pi.
    np.testing.assert_allclose(np.cov(world[:, :3, 0].T), np.eye(3) / 3, atol=0.01)
    assert rotation_angle(world[:, :3, :3]).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.01)


def test_upright_starts_turn_about_the_vertical_alone():
    world = first_set(hypotheses=500, initial="upright")
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-15)
    assert np.ptp(np.arctan2(world[:, 1, 0], world[:, 0, 0])) > 6.0


def test_centroid_starts_lie_around_the_mean_contact_whatever_else_is_known():
    known = [[0.1, 0.2, 0.3], [0.3, 0.2, 0.3], [1.5, 1.5, 1.5]]
    points = KnownPoints(free=np.full((9, 3), 2.0), known=known, known_sdf=[0.0, 0.0, 0.4])
    world = first_set(points, hypotheses=500, initial="contact_centroid")
    assert np.abs(world[:, :3, 3] - [0.2, 0.2, 0.3]).max() <= 0.05 + 1e-12


@pytest.mark.parametrize(("choice", "count"), [("elites", 6), ("estimates", 3), ("none", 0)])
def test_low_cost_set_is_what_is_chosen(choice, count):
    settings = OnlineSettings(low_cost_set=choice)
    problem = pose_problem(
        GRID,
        POINTS,
        workspace=WORKSPACE,
        free_resolution=0.01,
        key=KEY,
        settings=settings,
        previous=RESULT,
    )
    np.testing.assert_array_equal(problem.low_cost_set, RESULT.elites[:count])
    assert problem.initial_set.shape == (30, 4, 4)
