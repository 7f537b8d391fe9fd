"""Walks of poses: down to a floor, and among the likely ones below it."""

import numpy as np
import pytest

from chsel.methods.anchored.walking import stride_of, walked
from chsel.problem.noise import LEVELS, NoiseModel, noise_model
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, inverse
from chsel.problem.search_space import PlaneSettings, origin_bounds, search_space
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import object_centre
from tests.chsel.methods.scene import (
    BOX_GRID,
    BOX_SIDES,
    STANDING,
    TRUTH,
    WORKSPACE,
    energy_of,
    on_faces,
    poses_around_truth,
)

PLANE = PlaneSettings(plane_height=0.3 - 0.5 * BOX_SIDES[2])  # on which the box is at STANDING
NORMAL = NoiseModel((0.001,) * LEVELS, (1.0 / LEVELS,) * LEVELS)
AROUND = KnownPoints(
    known=apply(TRUTH, on_faces(24)),
    free=apply(TRUTH, on_faces(60, 0.004)),
    occupied=apply(TRUTH, on_faces(6, -0.002)),
)


def chains_of(energy, poses, floor, moves, kept=0, plane=None):
    space, stream = search_space(plane, BOX_GRID), StreamKey(5, 2).kernel_stream(Purpose.WALKS, 3)
    stride = stride_of(space, object_centre(BOX_GRID), origin_bounds(WORKSPACE, space, 0.15))
    return walked(energy, stride, poses, energy.of(poses), floor, moves, stream, kept)


def repeated(world_from_object, count):
    return Poses.of(np.tile(inverse(world_from_object), (count, 1, 1)))


@pytest.mark.parametrize(("plane", "dimension", "contacts"), [(None, 6, 60), (PLANE, 3, 24)])
def test_kept_states_are_drawn_from_the_likelihood(plane, dimension, contacts):
    """Of a normal distribution in d dimensions, energies are d / 2 above the least on average."""
    truth = TRUTH if plane is None else STANDING
    energy = energy_of(KnownPoints(known=apply(truth, on_faces(contacts))), NORMAL)
    chains = chains_of(energy, repeated(truth, 100), 50.0, 1500, 15, plane)
    above = chains.kept_energies[:, 5:] - energy.of(repeated(truth, 1))
    assert above.mean() == pytest.approx(0.5 * dimension, rel=0.08)
    assert above.var() == pytest.approx(0.5 * dimension, rel=0.25)
    space = search_space(plane, BOX_GRID)
    again = space.poses(space.encode(Poses(chains.poses)))
    np.testing.assert_allclose(again.numbers, chains.poses, atol=1e-9)


@pytest.mark.parametrize("points", [AROUND, KnownPoints(known=AROUND.known[:2])])
def test_energies_that_walks_carry_along_are_those_of_their_poses(points):
    """Walks gather free points once for many moves. None ends above the floor, or out of bounds."""
    energy = energy_of(points, noise_model(0.0005))
    starts = repeated(TRUTH, 12)
    floor = float(energy.of(starts).max()) + 4.0
    chains = chains_of(energy, starts, floor, 300, 4)
    for numbers, energies in (
        (chains.poses, chains.energies),
        (chains.kept.reshape(-1, 12), chains.kept_energies.reshape(-1)),
    ):
        poses = Poses(numbers)
        np.testing.assert_allclose(energy.of(poses), energies, rtol=1e-12, atol=1e-9)
        assert energies.max() <= floor
        products = np.einsum("nij,nkj->nik", poses.rotations, poses.rotations)
        np.testing.assert_allclose(products, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-10)
        assert (poses.origins >= np.array(WORKSPACE.lower) - 0.15).all()
        assert (poses.origins <= np.array(WORKSPACE.upper) + 0.15).all()
    assert np.abs(chains.kept - starts.numbers[:1]).max(axis=(0, 2)).min() > 1e-3


def test_walks_from_above_come_down_to_a_floor_and_stop():
    energy, starts = energy_of(AROUND, noise_model(0.0005)), poses_around_truth(12, 0.02, 0.2)
    before = energy.of(starts)
    floor = float(np.sort(before)[3])
    down = chains_of(energy, starts, floor, 200)
    assert (down.energies <= before).all()
    assert (down.energies <= floor).mean() > 0.7
    np.testing.assert_array_equal(down.poses[before <= floor], starts.numbers[before <= floor])
    assert chains_of(energy, starts, 0.0, 200).energies.mean() < floor
    kept = chains_of(energy, starts, -100.0, 20, 2)
    assert np.isinf(kept.kept_energies).all()
