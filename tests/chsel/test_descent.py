from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from chsel.adam import Adam
from chsel.descent import DescentSettings, descend
from chsel.errors import SettingError
from chsel.observer import NullObserver
from chsel.pose import compose, random_rotations
from chsel.space import SE3Space


class Bowl:
    """Cost |t - (1, 2, 3)|^2, whatever the rotation."""

    space = SE3Space()
    centre = np.array([1.0, 2.0, 3.0])

    def costs(self, vectors: np.ndarray) -> np.ndarray:
        return ((vectors[:, 6:] - self.centre) ** 2).sum(axis=1)

    def costs_and_gradients(self, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gradient = np.zeros_like(vectors)
        gradient[:, 6:] = 2.0 * (vectors[:, 6:] - self.centre)
        return self.costs(vectors), gradient


class Blocks(NullObserver):
    def __init__(self) -> None:
        self.iterations: list[int] = []

    def trace(self, stage: str, iteration: int, vectors: np.ndarray, cost: np.ndarray) -> None:
        self.iterations.append(iteration)


def starts(count: int) -> np.ndarray:
    stream = np.random.default_rng(0)
    return compose(random_rotations(stream, count), stream.uniform(-0.1, 0.1, (count, 3)))


def test_adam_takes_the_steps_of_torch() -> None:
    stream = np.random.default_rng(0)
    ours = stream.standard_normal((4, 3))
    theirs = torch.tensor(ours, requires_grad=True)
    optimizer = torch.optim.Adam([theirs], lr=0.03)
    adam = Adam(0.03)
    for _ in range(50):
        gradient = stream.standard_normal((4, 3))
        ours = ours - adam.step(gradient)
        theirs.grad = torch.tensor(gradient)
        optimizer.step()
    np.testing.assert_allclose(ours, theirs.detach().numpy(), rtol=1e-12)


def test_descent_finds_the_bottom_from_every_start() -> None:
    bowl: Any = Bowl()
    settings = DescentSettings(restarts=30, iterations=50, rate=0.03)
    poses, costs = descend(bowl, starts(5), settings, NullObserver())
    np.testing.assert_allclose(poses[:, :3, 3], np.tile(Bowl.centre, (5, 1)), atol=0.02)
    np.testing.assert_allclose(costs, bowl.costs(SE3Space().encode(poses)), rtol=1e-12)


def test_descent_ends_when_a_block_gains_nothing_unless_told_not_to() -> None:
    bowl: Any = Bowl()
    at_the_bottom = compose(
        random_rotations(np.random.default_rng(0), 3), np.tile(Bowl.centre, (3, 1))
    )
    stopping, going = Blocks(), Blocks()
    descend(bowl, at_the_bottom, DescentSettings(), stopping)
    descend(bowl, at_the_bottom, DescentSettings(stop_below=None), going)
    assert stopping.iterations == [50]
    assert going.iterations == list(range(50, 501, 50))


def test_no_restart_returns_the_starts() -> None:
    bowl: Any = Bowl()
    poses, costs = descend(bowl, starts(3), DescentSettings(restarts=0), NullObserver())
    np.testing.assert_allclose(poses, starts(3), atol=1e-15)
    assert (costs > 10.0).all()


def test_each_start_descends_as_if_it_were_alone() -> None:
    """Adam's step does not depend on the scale of a gradient, but for its epsilon."""
    bowl: Any = Bowl()
    settings = DescentSettings(restarts=2, iterations=20)
    together, _ = descend(bowl, starts(4), settings, NullObserver())
    alone, _ = descend(bowl, starts(4)[2:3], settings, NullObserver())
    np.testing.assert_allclose(together[2:3], alone, atol=1e-6)


def test_settings_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(SettingError, match="stop_below is nan"):
        DescentSettings(stop_below=float("nan"))
