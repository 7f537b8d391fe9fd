"""The relaxed cost in torch: closed forms of its terms, and its gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from chsel import CostSettings, KnownPoints, RelaxedCost
from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.objective import Objective
from chsel.problem.poses import Poses
from chsel.problem.search_space import SE3Space
from tests.chsel.samples import ball_grid, decode, random_poses

RADIUS = 0.1
SPHERE = ball_grid(RADIUS, 0.01, half=25)  # whose nodes hold the points of the closed forms
SETTINGS = CostSettings(penetration_tolerance=-0.01)
IDENTITY = np.eye(4)[None]


def value_and_translation_gradient(points, **changes):
    cost = RelaxedCost(SPHERE, points, settings=replace(SETTINGS, **changes))
    translation = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
    value = cost(torch.eye(3, dtype=torch.float64)[None], translation)
    (gradient,) = torch.autograd.grad(value.sum(), translation)
    return float(value.detach()), gradient[0].numpy()


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize(
    ("points", "value", "gradient"),
    [
        ({"free": [[0.05, 0, 0]]}, 20 * 0.04, [20 * -0.04, 0, 0]),
        ({"free": [[0.09, 0, 0], [0.2, 0, 0]]}, 0.0, [0, 0, 0]),
        ({"occupied": [[0.2, 0, 0]]}, 20 * 0.09, [20 * 0.09, 0, 0]),
        ({"occupied": [[0.1, 0, 0], [0.0, 0.05, 0]]}, 0.0, [0, 0, 0]),
        ({"known": [[0.13, 0, 0]]}, 0.03, [0.03, 0, 0]),
        ({"known": [[0.05, 0, 0]]}, 0.05, [-0.05, 0, 0]),
        ({"known": [[0.13, 0, 0]], "known_sdf": [0.03]}, 0.0, [0, 0, 0]),
        ({"known": [[0, 0, -0.13]], "known_sdf": [-0.02]}, 0.05, [0, 0, -0.05]),
    ],
)
def test_terms_of_a_sphere_have_their_closed_form(points, value, gradient, lookup):
    points = KnownPoints(**points)
    found, slope = value_and_translation_gradient(points, lookup=lookup)
    assert found == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(slope, gradient, atol=1e-9)
    compiled = CompiledCost(SPHERE, points, settings=replace(SETTINGS, lookup=lookup))
    vectors = SE3Space().encode(Poses.of(IDENTITY))
    costs, gradients = Objective(compiled, SE3Space()).costs_and_gradients(vectors)
    assert costs[0] == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(gradients[0, 6:], gradient, atol=1e-9)


def test_dead_band_shrinks_the_difference_towards_zero():
    points = KnownPoints(known=[[0.13, 0, 0], [0.105, 0, 0]])
    value, gradient = value_and_translation_gradient(points, known_tolerance=0.01)
    assert value == pytest.approx(0.02, abs=1e-9)
    np.testing.assert_allclose(gradient, [0.02, 0, 0], atol=1e-9)


def test_exact_gradient_is_the_derivative_of_the_value():
    points = KnownPoints(free=[[0.0512, 0, 0]], occupied=[[0, 0.181, 0]], known=[[0, 0, 0.131]])
    _, gradient = value_and_translation_gradient(points, gradient="exact")
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = 1e-4 * np.concatenate([np.eye(3), -np.eye(3)])
    costs = RelaxedCost(SPHERE, points, settings=replace(SETTINGS, gradient="exact")).evaluate(
        poses
    )
    np.testing.assert_allclose(gradient, (costs[:3] - costs[3:]) / 2e-4, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("free_term", ["direct", "interior"])
def test_gradient_by_the_search_vector_is_the_defined_point_gradient_chain_ruled(free_term):
    """J^T g, with J = d(R x + t)/dx by finite differences of the moved points alone."""
    stream = np.random.default_rng(0)
    points = KnownPoints(
        free=stream.uniform(-0.12, 0.12, (40, 3)),
        occupied=stream.uniform(-0.2, 0.2, (7, 3)),
        known=stream.uniform(-0.2, 0.2, (9, 3)),
        known_sdf=stream.uniform(-0.02, 0.02, 9),
    )
    settings = replace(SETTINGS, free_term=free_term, lookup="nearest")
    space = SE3Space()
    cost = RelaxedCost(SPHERE, points, settings=settings, free_resolution=0.02)
    vector = space.encode(Poses.of(random_poses(stream, 1, reach=0.02)))
    vector[:, :6] *= 1.3  # raw vectors are not orthonormal
    moved, point_gradients = point_gradients_by_hand(
        cost, points, vector=vector, free_term=free_term
    )
    expected = [
        ((moved(vector + step) - moved(vector - step)) / 2e-6 * point_gradients).sum()
        for step in 1e-6 * np.eye(9)
    ]
    compiled = CompiledCost(SPHERE, points, settings=settings, free_resolution=0.02)
    _, gradient = Objective(compiled, space).costs_and_gradients(vector)
    np.testing.assert_allclose(gradient[0], expected, rtol=1e-6, atol=1e-8)
    leaf = torch.tensor(vector, requires_grad=True)
    cost(*decode(space, leaf)).backward()
    np.testing.assert_allclose(leaf.grad[0], expected, rtol=1e-6, atol=1e-8)


def point_gradients_by_hand(cost, points, *, vector, free_term):
    """How the points that the cost looks at move, and dC/d(moved point) as the paper defines it."""
    interior = cost._inside.numpy() if free_term == "interior" else np.zeros((0, 3))
    free = points.free if free_term == "direct" else np.zeros((0, 3))
    world = np.concatenate([free, points.occupied, points.known])

    def moved(x):
        rotation, translation = (part[0].numpy() for part in decode(SE3Space(), torch.tensor(x)))
        to_world = (interior - translation) @ rotation  # R^T (m - t)
        return np.concatenate([world @ rotation.T + translation, to_world])

    at = moved(vector)
    s, n = SPHERE.at(at[: len(world)])
    f, o = len(free), len(free) + len(points.occupied)
    size = np.concatenate(
        [-20 * np.maximum(0, -0.01 - s[:f]), 20 * np.maximum(0, -0.01 + s[f:o]), s[o:] - points.sdf]
    )
    gradients = [size[:, None] * n]
    if free_term == "interior":
        rotation = decode(SE3Space(), torch.tensor(vector))[0][0].numpy()
        s, n = SPHERE.at(interior)
        first = points.free.min(axis=0)
        cells = set(map(tuple, np.rint((points.free - first) / 0.02).tolist()))
        seen = map(tuple, np.rint((at[len(world) :] - first) / 0.02).tolist())
        inside = np.array([cell in cells for cell in seen])
        gradients.append((inside * 20 * -s)[:, None] * (n @ rotation))
    return moved, np.concatenate(gradients)


def test_interior_term_counts_interior_points_in_free_voxels():
    """A half space of free voxels over half of the ball: half of sum -s over its deep nodes."""
    axis = np.arange(-12, 13) * 0.01
    free = np.stack(np.meshgrid(axis[axis > 0], axis, axis, indexing="ij"), -1).reshape(-1, 3)
    settings = replace(SETTINGS, free_term="interior", lookup="nearest")
    cost = RelaxedCost(SPHERE, KnownPoints(free=free), settings=settings, free_resolution=0.01)
    nodes = np.moveaxis(np.indices((51, 51, 51)), 0, -1) * 0.01 - 25 * 0.01
    s = np.sqrt((nodes**2).sum(-1)) - RADIUS
    deep = (s < -0.01) & (nodes[..., 0] > 0.005)
    assert cost.evaluate(IDENTITY)[0] == pytest.approx(20 * -s[deep].sum(), rel=1e-9)


def test_volume_normalise_weighs_interior_points_by_their_voxel_share():
    points = KnownPoints(free=[[0.0, 0.0, 0.0]])
    interior = replace(SETTINGS, free_term="interior")
    by_volume = replace(interior, volume_normalise=True)
    plain, normal = (
        RelaxedCost(SPHERE, points, settings=settings, free_resolution=0.04).evaluate(IDENTITY)[0]
        for settings in (interior, by_volume)
    )
    assert normal == pytest.approx(plain / 64)
