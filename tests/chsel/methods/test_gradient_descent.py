"""Descent by Adam beside that of torch, its race, and when it ends."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from chsel import CostSettings, KnownPoints, RelaxedCost, SdfGrid
from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.objective import Objective
from chsel.methods.gradient_descent import DescentSettings, descend
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import NullObserver
from chsel.problem.search_space import PlaneSettings, SE2Space, SE3Space, SearchSpace
from tests.chsel.methods.scene import Watcher
from tests.chsel.samples import decode, random_poses

SIDES = np.array([0.12, 0.08, 0.06])
BOX = SdfGrid.from_mesh(trimesh.creation.box(SIDES), 0.01)


def starts(count, seed=0, *, reach=0.02):
    return random_poses(np.random.default_rng(seed), count, reach=reach)


def scene(seed=0):
    stream = np.random.default_rng(seed)
    near = stream.uniform(-0.08, 0.08, (200, 3))
    return KnownPoints(
        near[:150], near[150:160], known=near[160:], known_sdf=stream.uniform(-0.01, 0.01, 40)
    )


def contacts():
    """One contact, so that many poses cost nothing."""
    return Objective(CompiledCost(BOX, KnownPoints(known=[[0.02, 0.0, 0.01]])), SE3Space())


def descended_by_torch(cost, space, *, vectors, rate, iterations):
    """torch.optim.Adam on the mean of the costs."""
    leaves: Tensor = torch.tensor(vectors, requires_grad=True)
    optimizer = torch.optim.Adam([leaves], lr=rate)
    for _ in range(iterations):
        optimizer.zero_grad()
        cost(*decode(space, leaves)).mean().backward()
        optimizer.step()
    return leaves.detach().numpy()


@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize(("free_term", "lookup"), [
    ("direct", "trilinear"), ("direct", "nearest"), ("interior", "trilinear"),
])  # fmt: skip
def test_descent_takes_the_steps_of_torch(free_term, lookup, plane):
    space: SearchSpace = SE3Space()
    if plane:
        space = SE2Space(PlaneSettings(axis=(0.0, 0.6, 0.8), offset=0.0), BOX)
    changes = CostSettings(free_term=free_term, lookup=lookup)
    points = scene()
    vectors = space.encode(Poses.of(starts(6)))
    expected = descended_by_torch(
        RelaxedCost(BOX, points, settings=changes),
        space,
        vectors=vectors,
        rate=0.001,
        iterations=30,
    )
    assert np.abs(expected - vectors).max() > 0.01
    objective = Objective(CompiledCost(BOX, points, settings=changes), space)
    found = objective.descended(vectors, len(vectors), rate=0.001, iterations=30)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_descent_reports_every_block_as_it_stands():
    objective, blocks = contacts(), Watcher()
    settings = DescentSettings(restarts=4, iterations=5, rate=0.001, stop_below=None)
    poses, costs = descend(objective, Poses.of(starts(3)), settings=settings, observer=blocks)
    assert blocks.iterations == [0, 5, 10, 15, 20]
    assert blocks.progressed == [("descent", done, 20) for done in (5, 10, 15, 20)]
    np.testing.assert_array_equal(blocks.traces[0].vectors, SE3Space().encode(Poses.of(starts(3))))
    for _, _, vectors, cost in blocks.traces:
        np.testing.assert_array_equal(cost, objective.costs(vectors))
        rows = vectors[:, :6].reshape(-1, 2, 3)
        products = rows @ rows.transpose(0, 2, 1)
        np.testing.assert_allclose(products, np.tile(np.eye(2), (3, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(SE3Space().encode(poses), blocks.traces[-1].vectors, atol=1e-15)
    np.testing.assert_array_equal(costs, blocks.traces[-1].cost)


def test_descent_ends_when_a_block_gains_nothing():
    free = KnownPoints(free=[[1.0, 1.0, 1.0]])  # costs nothing anywhere near
    objective = Objective(CompiledCost(BOX, free), SE3Space())
    watcher = Watcher()
    descend(objective, Poses.of(starts(3)), settings=DescentSettings(), observer=watcher)
    assert watcher.iterations == [0, 50]


def test_descent_goes_on_while_the_mean_gain_of_a_block_is_above_the_bound():
    objective, blocks = contacts(), Watcher()
    settings = DescentSettings(restarts=12, iterations=10, rate=0.001, stop_below=0.05)
    descend(objective, Poses.of(starts(4)), settings=settings, observer=blocks)
    costs = [trace.cost for trace in blocks.traces]
    gains = [
        np.where(a > 0.0, (a - b) / np.maximum(a, 1e-300), 0.0).mean() for a, b in pairwise(costs)
    ]
    assert len(gains) > 1
    assert all(gain > 0.05 for gain in gains[:-1])
    assert gains[-1] <= 0.05 or len(gains) == 12


def test_no_restart_returns_the_starts():
    none = DescentSettings(restarts=0)
    poses, _ = descend(contacts(), Poses.of(starts(3)), settings=none, observer=NullObserver())
    np.testing.assert_allclose(poses.matrices, starts(3), atol=1e-15)


def test_only_the_lowest_go_on_in_a_race_and_move_as_they_would_without_one():
    objective = contacts()
    racing = Watcher()
    free = Watcher()
    settings = DescentSettings(restarts=3, iterations=5, rate=0.001, stop_below=None)
    race = replace(settings, race=(1.0, 0.5, 0.2))
    descend(objective, Poses.of(starts(5)), settings=settings, observer=free)
    descend(objective, Poses.of(starts(5)), settings=race, observer=racing)
    going = np.arange(5)
    for block, count in enumerate((5, 3, 1)):
        before = racing.traces[block]
        after = racing.traces[block + 1]
        going = np.sort(going[np.argsort(before.cost[going])[:count]])
        out = np.setdiff1d(np.arange(5), going)
        np.testing.assert_array_equal(after.vectors[out], before.vectors[out])
        np.testing.assert_array_equal(after.vectors[going], free.traces[block + 1].vectors[going])
        np.testing.assert_array_equal(after.cost, objective.costs(after.vectors))
