from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel import CostSettings, KnownPoints, RelaxedCost, SdfGrid
from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.objective import Objective
from chsel.problem.poses import Poses
from chsel.problem.search_space import SE3Space
from tests.chsel.problem.torch_spaces import decode
from tests.chsel.samples import ball_grid, random_poses

RADIUS = 0.1
EYE = torch.eye(3, dtype=torch.float64)[None]
ORIGIN = torch.zeros((1, 3), dtype=torch.float64)


@pytest.fixture(scope="module")
def sphere():
    """Exact signed distance of a sphere at nodes that hold the points of the closed forms."""
    return ball_grid(RADIUS, 0.01, 25)


def value_and_translation_gradient(sphere, points, **changes):
    ours = replace(CostSettings(penetration_tolerance=-0.01), **changes)
    cost = RelaxedCost(sphere, points, ours)
    translation = ORIGIN.clone().requires_grad_()
    value = cost(EYE, translation)
    (gradient,) = torch.autograd.grad(value.sum(), translation)
    return float(value.detach()), gradient[0].numpy()


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize(
    ("points", "value", "gradient"),
    [
        (KnownPoints(free=[[0.05, 0, 0]]), 20 * 0.04, [20 * -0.04, 0, 0]),
        (KnownPoints(free=[[0.09, 0, 0]]), 0.0, [0, 0, 0]),
        (KnownPoints(free=[[0.2, 0, 0]]), 0.0, [0, 0, 0]),
        (KnownPoints(occupied=[[0.2, 0, 0]]), 20 * 0.09, [20 * 0.09, 0, 0]),
        (KnownPoints(occupied=[[0.1, 0, 0]]), 0.0, [0, 0, 0]),
        (KnownPoints(occupied=[[0.0, 0.05, 0]]), 0.0, [0, 0, 0]),
        (KnownPoints(known=[[0.13, 0, 0]]), 0.03, [0.03, 0, 0]),
        (KnownPoints(known=[[0.05, 0, 0]]), 0.05, [-0.05, 0, 0]),
        (KnownPoints(known=[[0.13, 0, 0]], known_sdf=[0.03]), 0.0, [0, 0, 0]),
        (KnownPoints(known=[[0, 0, -0.13]], known_sdf=[-0.02]), 0.05, [0, 0, -0.05]),
    ],
)
def test_terms_of_a_sphere_have_their_closed_form(sphere, points, value, gradient, lookup):
    found, slope = value_and_translation_gradient(sphere, points, lookup=lookup)
    assert found == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(slope, gradient, atol=1e-9)
    objective = Objective(
        CompiledCost(sphere, points, CostSettings(penetration_tolerance=-0.01, lookup=lookup)),
        SE3Space(),
    )
    costs, gradients = objective.costs_and_gradients(SE3Space().encode(Poses.of(np.eye(4)[None])))
    assert costs[0] == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(gradients[0, 6:], gradient, atol=1e-9)


def test_dead_band_shrinks_the_difference_towards_zero(sphere):
    points = KnownPoints(known=[[0.13, 0, 0], [0.105, 0, 0]])
    value, gradient = value_and_translation_gradient(
        sphere, points, known_tolerance=0.01, lookup="trilinear"
    )
    assert value == pytest.approx(0.02, abs=1e-9)
    np.testing.assert_allclose(gradient, [0.02, 0, 0], atol=1e-9)


def test_exact_gradient_is_the_derivative_of_the_value(sphere):
    points = KnownPoints(free=[[0.0512, 0, 0]], occupied=[[0, 0.181, 0]], known=[[0, 0, 0.131]])
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-4
        moved = [
            RelaxedCost(sphere, shifted(points, sign * step)).evaluate(np.eye(4)[None])[0]
            for sign in (-1, 1)
        ]
        _, gradient = value_and_translation_gradient(sphere, points, gradient="exact")
        assert gradient[axis] == pytest.approx((moved[1] - moved[0]) / 2e-4, rel=1e-3, abs=1e-6)


def shifted(points, by):
    return KnownPoints(points.free + by, points.occupied + by, points.known + by, points.sdf)


@pytest.mark.parametrize("free_term", ["direct", "interior"])
def test_gradient_by_the_search_vector_is_the_defined_point_gradient_chain_ruled(sphere, free_term):
    """J^T g, with J = d(R x + t)/dx by finite differences of the moved points alone."""
    stream = np.random.default_rng(0)
    points = KnownPoints(
        free=stream.uniform(-0.12, 0.12, (40, 3)),
        occupied=stream.uniform(-0.2, 0.2, (7, 3)),
        known=stream.uniform(-0.2, 0.2, (9, 3)),
        known_sdf=stream.uniform(-0.02, 0.02, 9),
    )
    changes = CostSettings(penetration_tolerance=-0.01, free_term=free_term, lookup="nearest")
    cost = RelaxedCost(sphere, points, changes, free_resolution=0.02)
    compiled = CompiledCost(sphere, points, changes, free_resolution=0.02)
    space = SE3Space()
    vector = space.encode(Poses.of(random_poses(stream, 1, 0.02)))
    vector[:, :6] *= 1.3  # raw vectors are not orthonormal
    _, gradient = Objective(compiled, space).costs_and_gradients(vector)
    expected = np.zeros(9)
    moved, point_gradients = point_gradients_by_hand(cost, sphere, points, vector, free_term)
    for i in range(9):
        ahead, behind = vector.copy(), vector.copy()
        ahead[0, i] += 1e-6
        behind[0, i] -= 1e-6
        slope = (moved(ahead) - moved(behind)) / 2e-6
        expected[i] = (slope * point_gradients).sum()
    np.testing.assert_allclose(gradient[0], expected, rtol=1e-6, atol=1e-8)
    leaf = torch.tensor(vector, requires_grad=True)
    cost(*decode(space, leaf)).backward()
    assert leaf.grad is not None
    np.testing.assert_allclose(leaf.grad[0], expected, rtol=1e-6, atol=1e-8)


def point_gradients_by_hand(cost, sphere, points, vector, free_term):
    """How the points that the cost looks at move, and dC/d(moved point) as the paper defines it."""
    interior = cost._inside.numpy() if free_term == "interior" else np.zeros((0, 3))
    free = points.free if free_term == "direct" else np.zeros((0, 3))
    world = np.concatenate([free, points.occupied, points.known])

    def moved(x):
        rotation, translation = (part[0].numpy() for part in decode(SE3Space(), torch.tensor(x)))
        to_world = (interior - translation) @ rotation  # R^T (m - t)
        return np.concatenate([world @ rotation.T + translation, to_world])

    def read(at):
        return sphere.at(at)

    at = moved(vector)
    s, n = read(at[: len(world)])
    f, o = len(free), len(free) + len(points.occupied)
    size = np.concatenate(
        [-20 * np.maximum(0, -0.01 - s[:f]), 20 * np.maximum(0, -0.01 + s[f:o]), s[o:] - points.sdf]
    )
    gradients = [size[:, None] * n]
    if free_term == "interior":
        rotation = decode(SE3Space(), torch.tensor(vector))[0][0].numpy()
        s, n = read(interior)
        cells = {tuple(c) for c in np.rint((points.free - points.free.min(axis=0)) / 0.02).tolist()}
        seen = np.rint((at[len(world) :] - points.free.min(axis=0)) / 0.02).tolist()
        inside = np.array([tuple(c) in cells for c in seen])
        gradients.append((inside * 20 * -s)[:, None] * (n @ rotation))
    return moved, np.concatenate(gradients)


def test_interior_term_counts_interior_points_in_free_voxels(sphere):
    """A half space of free voxels over half of the ball: half of sum -s over its deep nodes."""
    axis = np.arange(-12, 13) * 0.01
    free = np.stack(np.meshgrid(axis[axis > 0], axis, axis, indexing="ij"), -1).reshape(-1, 3)
    settings_ = CostSettings(penetration_tolerance=-0.01, free_term="interior", lookup="nearest")
    cost = RelaxedCost(sphere, KnownPoints(free=free), settings_, free_resolution=0.01)
    nodes = np.moveaxis(np.indices((51, 51, 51)), 0, -1) * 0.01 - 25 * 0.01
    s = np.sqrt((nodes**2).sum(-1)) - RADIUS
    deep = (s < -0.01) & (nodes[..., 0] > 0.005)
    assert cost.evaluate(np.eye(4)[None])[0] == pytest.approx(20 * -s[deep].sum(), rel=1e-9)


def test_volume_normalise_weighs_interior_points_by_their_voxel_share(sphere):
    points = KnownPoints(free=[[0.0, 0.0, 0.0]])
    plain, normal = (
        RelaxedCost(
            sphere,
            points,
            CostSettings(penetration_tolerance=-0.01, free_term="interior", volume_normalise=on),
            free_resolution=0.04,
        ).evaluate(np.eye(4)[None])[0]
        for on in (False, True)
    )
    assert normal == pytest.approx(plain / 64)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 200), poses=st.integers(1, 7))
def test_free_term_leaves_no_violated_point_out(seed, count, poses):
    stream = np.random.default_rng(seed)
    grid = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.01)
    transforms = random_poses(stream, poses, 0.05)
    free = stream.uniform(-0.15, 0.15, (count, 3))
    free[: count // 2] = np.round(free[: count // 2], 2)  # onto nodes and voxel borders
    for lookup in ("nearest", "trilinear"):
        cost = RelaxedCost(
            grid, KnownPoints(free=free), CostSettings(penetration_tolerance=-0.01, lookup=lookup)
        )
        expected = []
        for transform in transforms:
            moved = free @ transform[:3, :3].T + transform[:3, 3]
            s, _ = grid.at(moved, lookup=lookup)
            expected.append(20 * np.maximum(0, -0.01 - s).sum())
        np.testing.assert_allclose(cost.evaluate(transforms), expected, rtol=1e-9, atol=1e-12)


def test_a_pose_costs_the_same_alone_and_in_any_batch(sphere):
    stream = np.random.default_rng(1)
    transforms = random_poses(stream, 9, 0.1)
    points = KnownPoints(
        stream.uniform(-0.2, 0.2, (500, 3)), known=stream.uniform(-0.2, 0.2, (9, 3))
    )
    cost = RelaxedCost(sphere, points)
    alone = [cost.evaluate(one[None])[0] for one in transforms]
    np.testing.assert_array_equal(cost.evaluate(transforms), alone)
    assert cost.evaluate(transforms[:0]).shape == (0,)
