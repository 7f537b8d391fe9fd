"""The search for the true pose near one set by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import PoseError, SettingError
from chsel.plausible import pose_scan
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.plausible.pose_scan import PoseGrid, TruePoseSettings, find_true_pose
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, compose, inverse, rotation_angle, rotation_vector
from tests.chsel.plausible.scenes import box, scene

HALF = np.array([0.06, 0.09, 0.12])
QUICK = TruePoseSettings(
    rotations=100, cost=EvaluationCostSettings(lookup="trilinear", tolerance=0.005)
)


def test_the_true_pose_is_found_from_a_guess_some_centimetres_off():
    problem, truth = scene(np.random.default_rng(3), box(HALF, 0.01))
    stream = np.random.default_rng(0)
    sides = stream.uniform(-0.9, 0.9, (60, 3))
    axis, sign = np.arange(60) % 3, np.where(np.arange(60) % 2, 1.0, -1.0)
    sides[np.arange(60), axis] = sign
    nodes = stream.uniform(-0.3, 0.3, (2000, 3))
    free = nodes[(np.abs(nodes) > HALF + 0.002).any(axis=1)]
    points = KnownPoints(free=apply(truth, free), known=apply(truth, sides * HALF))
    problem = replace(problem, points=points)
    shift = compose(
        rotation_vector(np.array([[0.02, -0.01, 0.015]])), np.array([[0.05, -0.06, 0.03]])
    )[0]
    guess = compose((shift @ truth)[None, :3, :3], truth[None, :3, 3] + shift[None, :3, 3])[0]
    found = find_true_pose(problem, guess, QUICK)
    offset = found.world_from_object[:3, 3] - truth[:3, 3]
    assert np.sqrt((offset**2).sum()) < 0.004
    turn = found.world_from_object[:3, :3] @ truth[:3, :3].T
    assert rotation_angle(turn) < rotation_angle(shift[:3, :3])
    assert found.cost < 0.1 * found.guess_cost
    cost = EvaluationCost(problem, QUICK.cost)
    assert found.cost == cost.evaluate(inverse(found.world_from_object)[None])[0]
    assert find_true_pose(problem, guess, replace(QUICK, passes=1)).cost >= found.cost


def test_every_pass_looks_closer_around_the_best_pose_so_far(monkeypatch):
    """Reach becomes a spacing; spacing and angle shrink by their ratio, here to a quarter."""
    problem, truth = scene(np.random.default_rng(3), box(HALF))
    seen: list[PoseGrid] = []

    def watched(centre, offsets, rotations):
        seen.append(PoseGrid(centre, offsets, rotations))
        return seen[-1]

    monkeypatch.setattr(pose_scan, "PoseGrid", watched)
    settings = replace(QUICK, reach=0.08, spacing=0.02, rotations=400, angle=0.2, passes=3)
    best = truth
    for passes in (1, 2, 3):
        seen.clear()
        found = find_true_pose(problem, truth, replace(settings, passes=passes))
        last, closer = seen[-1], 0.25 ** (passes - 1)
        offsets = last.offsets.points()
        assert np.abs(offsets).max() == pytest.approx(0.08 * closer)
        assert np.diff(np.unique(offsets[:, 2]))[0] == pytest.approx(0.02 * closer)
        np.testing.assert_array_equal(last.centre, best[:3, 3])
        np.testing.assert_allclose(last.rotations[0], best[:3, :3], atol=1e-12)
        angles = rotation_angle(last.rotations[1:] @ best[:3, :3].T)
        spread = np.sqrt((angles**2).mean())  # of three normal coordinates
        assert spread == pytest.approx(3.0**0.5 * 0.2 * closer, rel=0.1)
        best = found.world_from_object


def test_a_guess_that_nothing_beats_stays():
    problem, truth = scene(np.random.default_rng(3), box(HALF))
    problem = replace(problem, points=KnownPoints(known=truth[None, :3, 3], known_sdf=[-0.06]))
    by = EvaluationCost(problem, QUICK.cost).evaluate(inverse(truth)[None])[0]
    found = find_true_pose(problem, truth, QUICK)
    assert found.cost <= by == found.guess_cost


def test_what_cannot_be_searched_is_named():
    problem, _ = scene(np.random.default_rng(3), box(HALF))
    with pytest.raises(PoseError, match="guess"):
        find_true_pose(problem, np.ones((4, 4)))
    with pytest.raises(SettingError, match="the number of offsets is"):
        find_true_pose(problem, np.eye(4), TruePoseSettings(spacing=0.001))
