from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, SdfGrid, Workspace
from chsel.problem.online_registration import (
    OnlineSettings,
    first_initial_set,
    pose_problem,
    updated_initial_set,
)
from chsel.problem.poses import axis_angle, compose, inverse, rotation_angle
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.streams import StreamKey
from tests.chsel.samples import hypotheses_at

WORKSPACE = Workspace((-0.1, -0.3, 0.0), (0.5, 0.3, 0.6))
KEY = StreamKey(5, 2)
MANY = 100_000


def result(count: int = 3) -> Hypotheses:
    rotation = axis_angle(np.tile([0.0, 0.6, 0.8], (count, 1)), np.linspace(0.1, 2.0, count))
    poses = compose(rotation, np.linspace(0.0, 0.3, 3 * count).reshape(count, 3))
    return replace(hypotheses_at(poses), elites=np.concatenate([poses, inverse(poses)]))


def test_first_of_the_updated_set_is_the_best_pose_to_the_bit() -> None:
    previous = result()
    updated = updated_initial_set(previous, KEY, OnlineSettings())
    assert updated[0].tobytes() == previous.object_from_world[0].tobytes()
    assert not (updated[1:] == updated[0]).all(axis=(1, 2)).any()


@pytest.mark.parametrize(
    ("law", "angle_rms"), [("axis_gauss", 0.3), ("rotvec_gauss", 0.3 * np.sqrt(3))]
)
def test_update_noise_has_the_set_deviations(law: str, angle_rms: float) -> None:
    previous = result()
    settings = OnlineSettings(hypotheses=MANY, rotation_law=law, keep_best=False)
    world = inverse(updated_initial_set(previous, KEY, settings))
    best = inverse(previous.object_from_world[0])
    deviation = (world[:, :3, 3] - best[:3, 3]).std(axis=0)
    np.testing.assert_allclose(deviation, 0.05, rtol=0.01)
    angle = rotation_angle(world[:, :3, :3] @ best[:3, :3].T)
    assert np.sqrt((angle**2).mean()) == pytest.approx(angle_rms, rel=0.02)


def test_axis_of_axis_gauss_is_uniform_on_the_sphere() -> None:
    settings = OnlineSettings(hypotheses=MANY, rotation_law="axis_gauss", translation_noise=0.0)
    world = inverse(updated_initial_set(result(), KEY, settings))[1:, :3, :3]
    turn = world @ inverse(result().object_from_world[0])[:3, :3].T
    vector = np.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ]
    )
    axis = vector / np.sqrt((vector**2).sum(axis=0))
    np.testing.assert_allclose(np.cov(axis), np.eye(3) / 3, atol=0.01)


def test_first_set_is_uniform_in_workspace_and_rotations() -> None:
    settings = OnlineSettings(hypotheses=MANY)
    world = inverse(first_initial_set(WORKSPACE, KnownPoints(), KEY, settings))
    lower, upper = WORKSPACE.bounds
    assert (world[:, :3, 3] >= lower).all()
    assert (world[:, :3, 3] <= upper).all()
    np.testing.assert_allclose(world[:, :3, 3].mean(axis=0), (lower + upper) / 2, atol=0.005)
    np.testing.assert_allclose(
        world[:, :3, 3].std(axis=0), (upper - lower) / np.sqrt(12), rtol=0.02
    )
    # Uniform on SO(3): every column is uniform on the sphere, and E[angle] = pi/2 + 2/pi.
    np.testing.assert_allclose(np.cov(world[:, :3, 0].T), np.eye(3) / 3, atol=0.01)
    assert rotation_angle(world[:, :3, :3]).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.01)


def test_upright_starts_turn_about_the_vertical_alone() -> None:
    settings = OnlineSettings(hypotheses=500, initial="upright")
    world = inverse(first_initial_set(WORKSPACE, KnownPoints(), KEY, settings))
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-15)
    assert np.ptp(np.arctan2(world[:, 1, 0], world[:, 0, 0])) > 6.0


def test_centroid_starts_lie_around_the_mean_contact_whatever_else_is_known() -> None:
    settings = OnlineSettings(hypotheses=500, initial="contact_centroid")
    points = KnownPoints(
        free=np.full((9, 3), 2.0),
        known=[[0.1, 0.2, 0.3], [0.3, 0.2, 0.3], [1.5, 1.5, 1.5]],
        known_sdf=[0.0, 0.0, 0.4],
    )
    world = inverse(first_initial_set(WORKSPACE, points, KEY, settings))
    assert np.abs(world[:, :3, 3] - [0.2, 0.2, 0.3]).max() <= 0.05 + 1e-12


@pytest.mark.parametrize(("choice", "count"), [("elites", 6), ("estimates", 3), ("none", 0)])
def test_low_cost_set_is_what_is_chosen(choice: str, count: int) -> None:
    grid = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
    points = KnownPoints(known=[[0.0, 0.0, 0.0]])
    settings = OnlineSettings(low_cost_set=choice)
    problem = pose_problem(grid, points, WORKSPACE, 0.01, KEY, settings, result())
    np.testing.assert_array_equal(problem.low_cost_set, result().elites[:count])
    assert problem.initial_set.shape == (30, 4, 4)


def test_every_step_draws_the_same_numbers_whatever_ran_before() -> None:
    settings = OnlineSettings()
    first = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 4), settings)
    first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 3), settings)
    again = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 4), settings)
    other = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(2, 4), settings)
    assert first.tobytes() == again.tobytes()
    assert (first != other).any(axis=(1, 2)).all()
