"""SVGD beside its equations in torch, and the object that it finds."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from chsel import RegistrationProblem, RelaxedCost
from chsel.errors import SettingError
from chsel.methods import svgd as kernels
from chsel.methods.svgd import Particles, Svgd, SvgdSettings, direct, particles_at
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import Poses
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import (
    GRID,
    SIDE,
    TRUTH,
    WORKSPACE,
    Watcher,
    around_truth,
    known_points,
)
from tests.chsel.samples import decode

ADAM = {"lr": 0.005, "betas": (0.9, 0.999), "eps": 1e-8}


@numba.njit
def _direct(particles, scale, median):
    direct(particles, scale, median)


def directions(vectors, scores, *, scale=0.01, median=False):
    """phi (B, d) of particles (B, d) with gradients of log p (B, d)."""
    particles: Particles = particles_at(vectors)
    particles.scores[:] = scores
    _direct(particles, scale, median)
    return particles.directions


def directions_by_torch(vectors, scores, *, scale, median=False):
    """The same by a matrix product and the gradient of the summed kernel by its first argument."""
    vectors = vectors.detach().requires_grad_()
    squares = ((vectors[:, None] - vectors.detach()[None]) ** 2).sum(dim=2)
    count = len(vectors)
    square = scale**2
    if median:
        below = torch.tril_indices(count, count, -1)
        pairs = squares.detach()[below[0], below[1]].numpy()
        square = float(np.median(pairs)) / (2.0 * np.log(count + 1.0))
    kernel = torch.exp(-squares / (2.0 * square + 1e-8))
    (pull,) = torch.autograd.grad(kernel.sum(), vectors)
    return (kernel.detach() @ scores - pull) / count


def posed(initial_set=None):
    initial_set = around_truth() if initial_set is None else initial_set
    return RegistrationProblem(
        sdf=GRID,
        points=known_points(TRUTH, 15),
        initial_set=initial_set,
        workspace=WORKSPACE,
        free_resolution=SIDE,
        key=StreamKey(5, 2),
    )


@pytest.mark.parametrize("median", [False, True])
@pytest.mark.parametrize("count", [2, 3, 4, 5, 8, 30])
def test_directions_are_those_of_torch(count, median):
    random = np.random.default_rng(count)
    for _ in range(20):
        vectors = np.round(random.standard_normal((count, 3)), 1)  # with ties of the median
        scores = 10.0 * random.standard_normal((count, 3))
        expected = directions_by_torch(
            torch.from_numpy(vectors), torch.from_numpy(scores), scale=2.0, median=median
        )
        ours = directions(vectors, scores, scale=2.0, median=median)
        np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-12)
    assert np.abs(ours - scores / count).max() > 0.1  # particles do act on each other


@pytest.mark.parametrize("kernel", ["reference", "median"])
def test_particles_move_as_torch_would_move_them(kernel):
    problem = posed(initial_set=around_truth(6, 0.02, shift=0.002))
    settings = SvgdSettings(kernel=kernel, scale=0.05, iterations=60)
    kept = Watcher()
    Svgd(settings).register(problem, kept)
    cost = RelaxedCost.of(problem, settings.cost)
    space = SE3Space()
    vectors = torch.from_numpy(Poses.of(problem.initial_set).vectors.copy()).requires_grad_()
    adam = torch.optim.Adam([vectors], **ADAM)
    for iteration in range(60):
        if iteration == kept.iterations[1] == 50:
            np.testing.assert_allclose(kept.traces[1].vectors, vectors.detach(), atol=1e-8)
        (gradient,) = torch.autograd.grad(cost(*decode(space, vectors)).sum(), vectors)
        phi = directions_by_torch(
            vectors, -settings.sharpness * gradient, scale=settings.scale, median=kernel == "median"
        )
        vectors.grad = -phi
        adam.step()
    np.testing.assert_allclose(kept.traces[2].vectors, vectors.detach(), atol=1e-8)


def test_the_object_is_found_where_it_was_touched_all_over():
    found = Svgd().register(posed())
    position, rotation = pose_errors(found.object_from_world, TRUTH, symmetry=ObjectSymmetry())
    assert position[0] < 0.005
    assert rotation[0] < 0.05


def test_a_particle_need_not_remember_what_is_around_it(monkeypatch):
    problem = posed()
    first = Svgd().register(problem).digest
    monkeypatch.setattr(kernels, "_MOST_REMEMBERED", 0)
    assert Svgd().register(problem).digest == first


def test_more_particles_than_pairs_can_be_held_of_are_one_clear_error():
    with pytest.raises(SettingError, match="number of poses in E_0 is 10001; accepted: at most"):
        Svgd().register(posed(initial_set=np.tile(np.eye(4), (10_001, 1, 1))))
