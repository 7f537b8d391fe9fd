"""The entropy that a hand sweeps, against the definition, voxel by voxel."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.next_probe.decision_problem import Actions
from chsel.next_probe.forecast import Forecast
from chsel.policies import build_policy
from chsel.policies.voxel_entropy import filled_points, occupancy_entropy, voxel_box
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, inverse
from tests.chsel.next_probe.decisions import (
    RADIUS,
    WORKSPACE,
    along_x,
    at,
    ball_problem,
    facing,
)

SIDE = 0.02
VOLUME = 4.0 / 3.0 * np.pi * RADIUS**3


def some_problem(points=None):
    """Five balls of unequal weight, and actions from several sides."""
    stream = np.random.default_rng(5)
    poses = at(*stream.uniform(-0.12, 0.12, (5, 3)).tolist())
    starts = stream.uniform(-0.1, 0.1, (12, 3))
    ahead = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, -0.8, 0.0]], 4, axis=0)
    hands = [facing(s - 0.3 * a, a) for s, a in zip(starts, ahead, strict=True)]
    actions = Actions(np.array(hands), stream.uniform(0.2, 0.6, 12))
    weights = np.array([0.4, 0.3, 0.2, 0.1, 0.0])
    return ball_problem(poses, actions, weights=weights, points=points)


def swept_by_definition(problem):
    """Of each action: sum over voxels that it sweeps of entropy times the chance to get there."""
    box = voxel_box(problem.workspace, SIDE)
    poses, weights = problem.belief.object_from_world, problem.belief.weights
    filled = np.zeros((len(poses), *box.counts), dtype=bool)
    for k, world_from_object in enumerate(inverse(poses)):
        points = apply(world_from_object, filled_points(problem.sdf, SIDE))
        x, y, z = np.floor((points - box.lower) / SIDE).astype(int).T
        filled[k, x, y, z] = True
    chance = np.einsum("k,k...->...", weights, filled)
    with np.errstate(all="ignore"):
        entropy = -chance * np.log(chance) - (1.0 - chance) * np.log(1.0 - chance)
    entropy = np.nan_to_num(entropy)
    points = problem.points
    for point in np.concatenate([points.free, points.occupied, points.known]):
        entropy[tuple(np.floor((point - box.lower) / SIDE).astype(int))] = 0.0
    travel = Forecast(problem, 0.005).first.travel
    front = problem.hand.front
    swept = np.zeros(len(problem.actions))
    for voxel in np.argwhere(entropy > 1e-12):
        centre = box.lower + (voxel + 0.5) * SIDE
        for a, hand in enumerate(problem.actions.world_from_hand):
            x, y, z = apply(inverse(hand), centre[None])[0]
            near = np.floor(([x, y] - front.lower) / front.cell).astype(int)
            lower, upper = np.maximum(near - 5, 0), np.maximum(near + 6, 0)
            depth = z - front.heights[lower[0] : upper[0], lower[1] : upper[1]].max(initial=-np.inf)
            if 0.0 <= depth <= problem.actions.length[a]:
                swept[a] += entropy[tuple(voxel)] * weights[travel[:, a] >= depth].sum()
    return swept


@pytest.mark.parametrize("known", [False, True])
def test_the_entropy_swept_is_that_of_the_definition(known):
    places = np.random.default_rng(1).uniform(-0.2, 0.2, (300, 3))
    points = KnownPoints(places[:100], places[100:200], places[200:]) if known else None
    problem = some_problem(points)
    policy = build_policy("voxel_entropy", {"voxel": SIDE})
    rated = policy.rate(problem, Forecast(problem, 0.005))
    expected = swept_by_definition(problem)
    assert (expected > 1.0).sum() >= 6
    assert rated == pytest.approx(expected, rel=1e-9)


def test_voxels_that_half_of_the_belief_fills_count_ln_2():
    problem = ball_problem(at((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    entropy = occupancy_entropy(problem, voxel_box(WORKSPACE, 0.01))
    assert np.unique(entropy) == pytest.approx([0.0, np.log(2.0)])
    volume = (entropy > 0.0).sum() * 0.01**3
    assert 2.0 * VOLUME < volume < 2.0 * VOLUME * 1.6  # voxels that the surface enters count too


@pytest.mark.parametrize(
    ("workspace", "voxel"),
    [
        (Workspace((5.0, 5.0, 5.0), (5.1, 5.1, 5.1)), 0.02),  # without the object
        (WORKSPACE, 1e-6),
    ],
)
def test_any_workspace_and_voxel_take_bounded_memory(workspace, voxel):
    problem = replace(some_problem(), workspace=workspace)
    assert np.prod(voxel_box(workspace, voxel).counts) <= 1e6
    decision = build_policy("voxel_entropy", {"voxel": voxel}).decide(problem)
    assert np.isfinite(decision.score[problem.available & (decision.blocked_chance <= 0.05)]).all()
