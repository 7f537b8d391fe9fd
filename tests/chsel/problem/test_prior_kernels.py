"""Kernels of the prior return what `PosePrior` does, and its gradient."""

import numpy as np
import pytest
import trimesh

from chsel.methods.anchored.fitting import moved_about
from chsel.numerics.compiler import compiled
from chsel.numerics.pose_tuples import pose_at
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import Poses, compose, inverse, rotation_vector
from chsel.problem.prior_kernels import add_prior, prior_energy, prior_of
from chsel.problem.sdf_grid import SdfGrid

PIVOT = (0.02, -0.01, 0.03)


@compiled
def energies(prior, poses, out):
    for n in range(len(poses)):
        out[n] = prior_energy(prior, pose_at(poses, n))


@compiled
def sums_of(prior, poses, pivot, sums):
    add_prior(prior, pose_at(poses, 0), pivot, sums)


@compiled
def energy_after(prior, poses, pivot, twist):
    turn = twist[0], twist[1], twist[2]
    shift = twist[3], twist[4], twist[5]
    return prior_energy(prior, moved_about(pose_at(poses, 0), pivot, turn, shift))


@pytest.fixture(scope="module")
def sdf() -> SdfGrid:
    box = trimesh.creation.box((0.06, 0.04, 0.1))
    return SdfGrid.from_mesh(box, resolution=0.005, padding=0.03)


def random_poses(stream, count):
    turns = rotation_vector(stream.normal(size=(count, 3)))
    return inverse(compose(turns, 0.1 * stream.normal(size=(count, 3))))


def priors():
    stream = np.random.default_rng(5)
    roots = stream.normal(size=(4, 6, 6)) * np.repeat([0.1, 1.0], 3)[:, None]
    centre = {"centre": [0.02, -0.03, 0.05], "centre_noise": 0.1}
    axis = {"axis": [0.3, 0.2, 0.9], "along": [0.1, -0.4, 0.8], "axis_noise": 1.2}
    poses = {
        "object_from_world": random_poses(stream, 4),
        "covariances": roots @ np.swapaxes(roots, 1, 2) + np.diag(np.repeat([0.05, 0.5], 3)) ** 2,
        "weights": [0.1, 0.2, 0.3, 0.4],
    }
    point = {"point": [0.01, 0.02, -0.04]}
    return {
        "centre": PosePrior(**centre),
        "point": PosePrior(**centre, **point),
        "axis": PosePrior(**axis),
        "poses": PosePrior(**poses),
        "all": PosePrior(**centre, **point, **axis, **poses),
    }


@pytest.mark.parametrize("name", priors())
def test_kernels_have_the_energy_of_the_prior(sdf, name):
    prior = priors()[name]
    stream = np.random.default_rng(0)
    poses = random_poses(stream, 200)
    if prior.object_from_world is not None:  # near them, and turned by half a turn
        half = compose(rotation_vector(np.pi * np.eye(3)), np.zeros((3, 3)))
        near = prior.object_from_world
        poses = np.concatenate([poses, near, *[each @ near for each in half]])
    poses = Poses.of(poses)
    out = np.empty(len(poses))
    energies(prior_of(prior, sdf), poses.numbers, out)
    expected = prior.energies(poses, sdf)
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(out, expected, atol=1e-9)


def test_without_a_prior_every_energy_is_zero(sdf):
    numbers = Poses.of(random_poses(np.random.default_rng(0), 3)).numbers
    out = np.ones(3)
    energies(prior_of(None, sdf), numbers, out)
    np.testing.assert_array_equal(out, 0.0)
    sums = np.zeros((8, 6))
    sums_of(prior_of(None, sdf), numbers, PIVOT, sums)
    np.testing.assert_array_equal(sums, 0.0)


@pytest.mark.parametrize("name", priors())
def test_sums_have_the_gradient_of_the_energy(sdf, name):
    prior = priors()[name]
    values = prior_of(prior, sdf)
    chosen = Poses.of(random_poses(np.random.default_rng(3), 60))
    between = prior.energies(chosen, sdf)
    chosen = chosen[(between > 0.3) & (between < 6.0)][:5]
    assert len(chosen) >= 3
    for n in range(len(chosen)):
        numbers = chosen.numbers[n : n + 1]
        sums = np.zeros((8, 6))
        sums_of(values, numbers, PIVOT, sums)
        step = 1e-5
        rises = [
            energy_after(values, numbers, PIVOT, step * sign * twist)
            for twist in np.eye(6)
            for sign in (1.0, -1.0)
        ]
        slopes = (np.array(rises[::2]) - rises[1::2]) / (2.0 * step)
        np.testing.assert_allclose(sums[6], slopes, rtol=1e-5, atol=1e-5 * np.abs(slopes).max())
        assert np.abs(slopes).max() > 0.1
        lower = np.tril(sums[:6])
        curvature = lower + np.tril(lower, -1).T
        assert np.linalg.eigvalsh(curvature).min() > -1e-9 * np.abs(curvature).max()


def test_the_curvature_at_a_single_pose_is_that_of_its_covariance(sdf):
    """At the pose itself the energy is a parabola, whose curvature the sums have."""
    prior = priors()["poses"]
    alone = PosePrior(
        object_from_world=prior.object_from_world[:1], covariances=prior.covariances[:1]
    )
    values = prior_of(alone, sdf)
    numbers = Poses.of(alone.object_from_world).numbers
    sums = np.zeros((8, 6))
    sums_of(values, numbers, PIVOT, sums)
    lower = np.tril(sums[:6])
    curvature = lower + np.tril(lower, -1).T
    stream = np.random.default_rng(7)
    for _ in range(5):
        twist = 1e-4 * stream.normal(size=6)
        rise = energy_after(values, numbers, PIVOT, twist)
        assert rise == pytest.approx(0.5 * twist @ curvature @ twist, rel=1e-3)
