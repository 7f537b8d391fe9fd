"""Steps of many poses against the same steps by numpy."""

from __future__ import annotations

import numpy as np

from chsel.numerics.threads import threads
from chsel.plausible.random_steps import stepped
from chsel.problem.poses import Poses, compose, inverse, product, rotation_vector
from tests.chsel.samples import random_poses


def test_steps_are_those_of_numpy_to_the_bit() -> None:
    stream = np.random.default_rng(1)
    poses, steps = random_poses(stream, 5000, 2.0), stream.normal(size=(5000, 6))
    steps[7, 3:], steps[8, 4:], steps[9], steps[10] = 0.0, 0.0, 0.0, 100.0
    turn = product(rotation_vector(0.1 * steps[:, 3:]), poses[:, :3, :3])
    expected = compose(turn, poses[:, :3, 3] + 0.01 * steps[:, :3])
    with threads(2):
        found, to_object = stepped(poses, steps, 0.01, 0.1)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(to_object.numbers, Poses.of(inverse(expected)).numbers)
