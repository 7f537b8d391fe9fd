"""The compiled cost against the torch cost, and its own bits against themselves."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel import CostSettings, KnownPoints, RelaxedCost, SdfGrid
from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import LANES
from chsel.cost.objective import BETA1, BETA2, EPSILON, Objective
from chsel.errors import PoseError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.problem.poses import Poses, compose, random_rotations
from chsel.problem.search_space import PlaneSettings, SE2Space, SE3Space, SearchSpace
from tests.chsel.problem.torch_spaces import decode
from tests.chsel.samples import ball_grid, random_poses

pytestmark = pytest.mark.filterwarnings("ignore:free_term interior uses")
BOX_SIDES = (0.12, 0.08, 0.06)


@cache
def grid_of(name):
    if name == "sphere":
        return ball_grid(0.05, 0.01, 9)
    if name == "box":
        return SdfGrid.from_mesh(trimesh.creation.box(BOX_SIDES), 0.006, padding=0.03)
    if name == "dyadic":  # a grid whose nodes and borders are exact numbers
        return ball_grid(0.07, 2.0**-6, 8)
    legs = [trimesh.creation.box(sides) for sides in ((0.16, 0.07, 0.06), (0.07, 0.14, 0.06))]
    legs[0].apply_translation([0.05, -0.04, 0.0])
    resolution = 0.004 if name == "fine l_shape" else 0.012
    return SdfGrid.from_mesh(trimesh.boolean.union(legs), resolution, padding=0.04)


@dataclass(frozen=True)
class Case:
    shape: str
    points: KnownPoints
    settings: CostSettings
    free_resolution: float
    vectors: FloatArray
    space: SearchSpace

    @property
    def sdf(self):
        return grid_of(self.shape)

    def objective(self, culling="octree"):
        cost = CompiledCost(
            self.sdf,
            self.points,
            self.settings,
            free_resolution=self.free_resolution,
            culling=culling,
        )
        return Objective(cost, self.space)

    def other_cullings(self):
        """Every culling but the default."""
        return [self.objective("none")]


@st.composite
def cases(draw, free_terms=("direct", "interior")):
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.sampled_from(["sphere", "box", "l_shape"]))
    resolution = draw(st.sampled_from([0.01, 0.022, 0.03]))
    count = draw(st.sampled_from([0, 1, 2, 9, 100, 3000]))
    free = stream.uniform(-0.15, 0.15, (count, 3))
    if draw(st.booleans()):
        free = np.unique(np.rint(free / resolution), axis=0) * resolution
    known = stream.uniform(-0.15, 0.15, (draw(st.integers(0, 12)), 3))
    free_term = draw(st.sampled_from(free_terms))
    gradients = ("defined", "exact") if free_term == "direct" else ("defined",)
    changes = CostSettings(
        penetration_tolerance=draw(st.sampled_from([0.0, -0.004, -0.01, -0.015])),
        free_term=free_term,
        lookup=draw(st.sampled_from(["nearest", "trilinear"])),
        outside=draw(st.sampled_from(["surface_point", "bounding_box"])),
        gradient=draw(st.sampled_from(gradients)),
        volume_normalise=draw(st.booleans()),
        known_tolerance=draw(st.sampled_from([0.0, 0.015])),
    )
    occupied = stream.uniform(-0.15, 0.15, (draw(st.integers(0, 6)), 3))
    points = KnownPoints(free, occupied, known, stream.uniform(-0.03, 0.03, len(known)))
    count, reach = draw(st.integers(1, 9)), draw(st.sampled_from([0.03, 0.1, 0.4]))
    space = SE3Space()
    if draw(st.integers(0, 3)) == 0:
        axis = tuple(stream.standard_normal(3).tolist())
        space = SE2Space(PlaneSettings(axis=axis, offset=0.01), grid_of(shape))
    vectors = space.encode(Poses.of(random_poses(stream, count, reach)))
    if space.dimension == 9:  # raw vectors are not orthonormal
        vectors[:, :6] += stream.uniform(-0.2, 0.2, (count, 6))
    return Case(shape, points, changes, resolution, vectors, space)


def oracle(cost, space, vectors):
    """Costs (B,) and gradients (B, d) by torch."""
    leaves = torch.tensor(vectors, requires_grad=True)
    values = cost(*decode(space, leaves))
    values.sum().backward()
    assert leaves.grad is not None
    return [values.detach().numpy(), leaves.grad.numpy()]


def assert_equals_torch(case):
    cost = RelaxedCost(case.sdf, case.points, case.settings, free_resolution=case.free_resolution)
    values, gradients = oracle(cost, case.space, case.vectors)
    found, slopes = case.objective().costs_and_gradients(case.vectors)
    np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-14)
    size = 1.0 + np.abs(gradients).max(axis=1, keepdims=True)
    np.testing.assert_allclose(slopes / size, gradients / size, rtol=0.0, atol=1e-12)


def assert_same_bits(first, second):
    for one, other in zip(np.atleast_1d(first), np.atleast_1d(second), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        assert one.shape == other.shape
        np.testing.assert_array_equal(one.view(np.int64), other.view(np.int64))


@settings(max_examples=150, deadline=None)
@given(case=cases())
def test_costs_and_gradients_are_those_of_the_torch_cost(case):
    assert_equals_torch(case)


@settings(max_examples=100, deadline=None)
@given(case=cases())
def test_culling_batches_threads_and_gradients_change_no_bit(case):
    objective, vectors = case.objective(), case.vectors
    costs, gradients = objective.costs_and_gradients(vectors)
    for other in case.other_cullings():
        other_costs, other_gradients = other.costs_and_gradients(vectors)
        assert_same_bits(costs, other_costs)
        assert_same_bits(gradients, other_gradients)
    assert_same_bits(costs, objective.costs(vectors))
    for n in range(len(vectors)):
        cost, gradient = objective.costs_and_gradients(vectors[n : n + 1].copy())
        assert_same_bits(cost[0], costs[n])
        assert_same_bits(gradient[0], gradients[n])
    for count in (2, 3):
        with threads(count):
            again, slopes = objective.costs_and_gradients(vectors)
            assert_same_bits(objective.costs(vectors), costs)
        assert_same_bits(again, costs)
        assert_same_bits(slopes, gradients)


def descended_plainly(objective, vectors, divisor, rate, iterations):
    """Adam, asking all points at every step; the operations are those of the kernel."""
    mean, square = np.zeros_like(vectors), np.zeros_like(vectors)
    power1 = power2 = 1.0
    for _ in range(iterations):
        _, gradients = objective.costs_and_gradients(vectors)
        power1 *= BETA1
        power2 *= BETA2
        slope = gradients / divisor
        mean = BETA1 * mean + (1.0 - BETA1) * slope
        square = BETA2 * square + (1.0 - BETA2) * slope * slope
        step = rate * (mean / (1.0 - power1))
        vectors = vectors - step / (np.sqrt(square / (1.0 - power2)) + EPSILON)
    return vectors


@settings(max_examples=100, deadline=None)
@given(case=cases(), rate=st.sampled_from([1e-4, 1e-3, 0.01, 0.1, 1.0]))
def test_descent_with_neighbour_lists_is_to_the_bit_descent_over_all_points(case, rate):
    plain = descended_plainly(case.objective("none"), case.vectors, 3.0, rate, 40)
    for other in case.other_cullings():
        assert_same_bits(other.descended(case.vectors, 3.0, rate, 40), plain)
    objective = case.objective()
    with threads(2):
        assert_same_bits(objective.descended(case.vectors, 3.0, rate, 40), plain)
        assert_same_bits(objective.descended(case.vectors[:1].copy(), 3.0, rate, 40), plain[:1])


class Turntable(SE2Space):
    """A plane on which the object can only turn."""

    def __init__(self, sdf):
        super().__init__(PlaneSettings(offset=0.0), sdf)
        self.arrays = self.arrays._replace(e_u=(0.0, 0.0, 0.0), e_v=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("turn", [0.004, 0.02, 0.1])
@pytest.mark.parametrize("free_term", ["direct", "interior"])
def test_an_object_that_turns_misses_none_of_the_points_that_it_sweeps(free_term, turn):
    """Contacts far away turn it by about `turn` radians a step, at first."""
    free = np.random.default_rng(14).uniform(-0.2, 0.2, (100_000, 3)) * [1.0, 1.0, 0.2]
    points = KnownPoints(free, known=[[0.0, 3.0, 0.0], [0.1, -3.0, 0.0]])
    changes = CostSettings(free_term=free_term, known_scale=1e6)
    vectors = np.zeros((8, 3))
    vectors[:, 0] = np.arange(8) * 0.7
    case = Case("fine l_shape", points, changes, 0.005, vectors, Turntable(grid_of("l_shape")))
    plain = descended_plainly(case.objective("none"), vectors, 1.0, turn, 50)
    assert (np.abs(plain[:, 0] - vectors[:, 0]) > 5.0 * turn).any()
    assert_same_bits(case.objective().descended(vectors, 1.0, turn, 50), plain)


def test_an_object_that_comes_into_free_space_from_outside_misses_none_of_its_points():
    """A corner of a box comes first, where a sphere around the box fits it best."""
    corner = np.array(BOX_SIDES) / 2.0
    x = corner / np.linalg.norm(corner)
    y = np.cross(x, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(x, [0.0, 0.0, 1.0]))
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)  # its columns are the world's axes
    away = np.linalg.norm(corner) + np.arange(0.0, 0.05, 0.003)
    transforms = compose(np.tile(rotation, (len(away), 1, 1)), away[:, None] * x)
    free = np.random.default_rng(17).uniform([0.0, -0.05, -0.05], [0.2, 0.05, 0.05], (20_000, 3))
    points = KnownPoints(free, known=[[1.0, 0.0, 0.0], [1.0, 0.1, 0.0]])
    changes = CostSettings(penetration_tolerance=0.0)
    vectors = SE3Space().encode(Poses.of(transforms))
    case = Case("box", points, changes, 0.005, vectors, SE3Space())
    plain = vectors
    for rate in (0.002, 0.005):
        plain = descended_plainly(case.objective("none"), vectors, 1.0, rate, 20)
        assert_same_bits(case.objective().descended(vectors, 1.0, rate, 20), plain)
    free_alone = replace(case, points=KnownPoints(free)).objective("none")
    assert not free_alone.costs(vectors)[1:].any()
    assert (free_alone.costs(plain) > 0.0).sum() > 5


def test_by_default_alpha_is_a_quarter_of_a_free_voxel_or_half_of_the_greatest_depth():
    sdf = grid_of("sphere")  # 5 cm deep
    for resolution, alpha in ((0.02, -0.005), (0.4, -0.025)):
        assert CostSettings().of_object(sdf, resolution).alpha == pytest.approx(alpha)


def summed_over_all(cost, sdf, free, pose):
    """Eq. 8 over every free point, one after the other in the order of the tree."""
    x, y, z = free[cost.model.free.tree.order].T
    moved = [
        pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z + pose[9 + i] for i in range(3)
    ]
    changes = cost.settings
    s, _ = sdf.at(np.stack(moved, axis=1), lookup=changes.lookup, outside=changes.outside)
    violation = np.maximum(changes.penetration_tolerance - s, 0.0)
    return float(np.add.accumulate(changes.free_scale * violation)[-1])


def lattice_points():
    axis = (np.arange(59) - 29) * 0.005
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)[:200_000]


def scattered_points():
    return np.random.default_rng(3).uniform(-0.2, 0.2, (200_000, 3))


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize("make", [lattice_points, scattered_points])
def test_200_000_free_points_cost_to_the_bit_what_their_sum_one_by_one_is(make, lookup):
    sdf, free, stream = grid_of("l_shape"), make(), np.random.default_rng(4)
    changes = CostSettings(lookup=lookup)
    transforms = random_poses(stream, 5, 0.2)
    transforms[0] = np.eye(4)
    poses = Poses.of(transforms)
    culled, direct = (
        CompiledCost(sdf, KnownPoints(free), changes, free_resolution=0.005, culling=culling)
        for culling in ("octree", "none")
    )
    costs = culled.costs(poses)
    assert costs[0] > 1.0
    assert_same_bits(costs, direct.costs(poses))
    assert_same_bits(costs, [summed_over_all(culled, sdf, free, pose) for pose in poses.numbers])


def border_points(sdf):
    """Nodes, middles between them, corners of the grid, and the numbers next to all of these."""
    stream, (first, last) = np.random.default_rng(5), sdf.bounds
    nodes = stream.integers(0, np.array(sdf.shape), (300, 3))
    halves = nodes - 0.5 * stream.integers(0, 2, (300, 3))
    points = [first + halves * sdf.resolution]
    corners = np.where(np.indices((2, 2, 2)).reshape(3, -1).T == 0, first, last)
    faces = np.where(stream.integers(0, 2, (60, 3)) == 0, corners[stream.integers(0, 8, 60)], 0.01)
    points += [corners, faces]
    exact = np.concatenate(points)
    return np.concatenate([exact, np.nextafter(exact, -np.inf), np.nextafter(exact, np.inf)])


@pytest.mark.parametrize("gradient", ["defined", "exact"])
@pytest.mark.parametrize("outside", ["surface_point", "bounding_box"])
@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
def test_points_on_borders_of_voxels_and_of_the_grid_read_what_the_torch_cost_reads(
    lookup, outside, gradient
):
    sdf = grid_of("dyadic")
    changes = CostSettings(lookup=lookup, outside=outside, gradient=gradient)
    at = border_points(sdf)
    turns = np.array(
        [np.eye(3), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    )
    shifts = np.array([[0, 0, 0], [0.5, -1.0, 2.0], [2.0**-7, 0, 2.0**-6]])
    vectors = SE3Space().encode(Poses.of(compose(turns, shifts)))
    for n in range(len(shifts)):
        world = (at - shifts[n]) @ turns[n]  # exact but for the numbers next to others
        for points in (KnownPoints(world), KnownPoints(occupied=world), KnownPoints(known=world)):
            one = vectors[n : n + 1].copy()
            assert_equals_torch(Case("dyadic", points, changes, sdf.resolution, one, SE3Space()))


def test_free_voxels_are_read_on_their_borders_as_the_torch_cost_reads_them():
    step = 2.0**-6
    free = np.array([[0.0, 0.0, 0.0], [step, 0.0, 0.0], [0.0, 2 * step, step], [3 * step, 0, 0]])
    changes = CostSettings(free_term="interior", interior_spacing=0.5 * step)
    shifts = step * np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.25], [1.5, -1.0, 2.5]])
    vectors = SE3Space().encode(Poses.of(compose(np.tile(np.eye(3), (3, 1, 1)), shifts)))
    case = Case("dyadic", KnownPoints(free), changes, step, vectors, SE3Space())
    assert case.objective().costs(vectors)[0] > 0.0
    assert_equals_torch(case)


def edge_points(name):
    stream = np.random.default_rng(6)
    near, none = stream.uniform(-0.08, 0.08, (60, 3)), np.zeros((0, 3))
    known_sdf = stream.uniform(-0.02, 0.02, 60)
    flat = near * [1.0, 1.0, 0.0]
    return {
        "nothing at all": KnownPoints(),
        "free alone": KnownPoints(near),
        "occupied alone": KnownPoints(occupied=near),
        "known alone": KnownPoints(known=near, known_sdf=known_sdf),
        "no free": KnownPoints(none, near[:5], near, known_sdf),
        "no occupied": KnownPoints(near, none, near, known_sdf),
        "no known": KnownPoints(near, near[:5]),
        "one free": KnownPoints(near[:1] * 0.1),
        "one occupied": KnownPoints(occupied=near[:1]),
        "one known": KnownPoints(known=near[:1], known_sdf=[-0.01]),
        "one point a thousand times": KnownPoints(np.tile(near[:1] * 0.1, (1000, 1))),
        "some points many times": KnownPoints(np.repeat(near, 30, axis=0)),
        "in a plane": KnownPoints(np.repeat(flat, 3, axis=0)),
        "on a line": KnownPoints(np.linspace(-0.2, 0.2, 500)[:, None] * [1.0, 0.0, 0.0]),
        "10 m away": KnownPoints(near + 10.0, near, near - 10.0),
        "in two clusters 1000 km apart": KnownPoints(np.concatenate([near, near + 1e6])),
    }[name]


EDGES = [
    "nothing at all", "free alone", "occupied alone", "known alone", "no free", "no occupied",
    "no known", "one free", "one occupied", "one known", "one point a thousand times",
    "some points many times", "in a plane", "on a line", "10 m away",
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "free_term"),
    [(name, term) for name in EDGES for term in ("direct", "interior")]
    + [("in two clusters 1000 km apart", "direct")],  # too many voxels for the other
)
def test_rare_sets_of_points_cost_what_the_torch_cost_says(name, free_term):
    stream = np.random.default_rng(7)
    vectors = SE3Space().encode(Poses.of(random_poses(stream, 4, 0.02)))
    changes = CostSettings(free_term=free_term)
    case = Case("box", edge_points(name), changes, 0.01, vectors, SE3Space())
    assert_equals_torch(case)
    culled, direct = case.objective(), case.objective("none")
    for one, other in zip(
        culled.costs_and_gradients(vectors), direct.costs_and_gradients(vectors), strict=True
    ):
        assert_same_bits(one, other)
    plain = descended_plainly(direct, vectors, 4.0, 0.01, 30)
    assert_same_bits(culled.descended(vectors, 4.0, 0.01, 30), plain)


@pytest.mark.parametrize("free_term", ["direct", "interior"])
@pytest.mark.parametrize("far", [1e6, 6.4e6, 1e9])
def test_a_scene_far_from_the_origin_is_culled_without_loss(far, free_term):
    """At 1e9 m, neighbouring doubles are 0.1 micrometres apart."""
    stream = np.random.default_rng(8)
    shift = np.array([far, -far, 0.5 * far])
    free = np.rint(stream.uniform(-8.0, 8.0, (400, 3))) * 0.01 + shift
    turns = random_rotations(stream, 6)
    turns[0] = np.eye(3)
    translations = -(turns @ shift) + stream.uniform(-0.03, 0.03, (6, 3))
    vectors = SE3Space().encode(Poses.of(compose(turns, translations)))
    points = KnownPoints(free, known=free[:9] + 0.01)
    changes = CostSettings(free_term=free_term)
    case = Case("box", points, changes, 0.01, vectors, SE3Space())
    culled, direct = case.objective(), case.objective("none")
    assert (culled.costs(vectors)[1:] > 0.0).any()
    assert_same_bits(culled.costs(vectors), direct.costs(vectors))
    plain = descended_plainly(direct, vectors, 1.0, 1e-3, 30)
    assert_same_bits(culled.descended(vectors, 1.0, 1e-3, 30), plain)


@pytest.mark.parametrize("free_term", ["direct", "interior"])
@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e300])
def test_a_pose_that_is_not_finite_leaves_the_lanes_beside_it_to_the_bit_as_they_are(
    bad, free_term
):
    stream = np.random.default_rng(16)
    near = stream.uniform(-0.1, 0.1, (900, 3))
    points = KnownPoints(near, near[:3], near[:9])
    vectors = SE3Space().encode(Poses.of(random_poses(stream, LANES, 0.02)))
    changes = CostSettings(free_term=free_term, lookup="nearest")
    case = Case("l_shape", points, changes, 0.02, vectors, SE3Space())
    objective = case.objective()
    costs, slopes = objective.costs_and_gradients(vectors)
    moved = objective.descended(vectors, 3.0, 0.01, 20)
    assert (costs > 0.0).all()
    assert (moved != vectors).any(axis=1).all()
    for lane in range(LANES):
        others = np.arange(LANES) != lane
        spoiled = vectors.copy()
        spoiled[lane, 6 + lane % 3] = bad
        found, gradients = objective.costs_and_gradients(spoiled)
        assert found[lane] == np.inf
        assert not gradients[lane].any()
        assert_same_bits(found[others], costs[others])
        assert_same_bits(gradients[others], slopes[others])
        assert_same_bits(objective.costs(spoiled)[others], costs[others])
        assert_same_bits(objective.descended(spoiled, 3.0, 0.01, 20)[others], moved[others])


def test_an_sdf_that_32_bits_cannot_hold_is_read_in_64_bits():
    sdf = grid_of("sphere")
    node = np.array([[0.03, 0.01, 0.02]])
    cost = CompiledCost(sdf, KnownPoints(known=node), CostSettings(lookup="nearest"))
    value = np.sqrt(0.0014) - 0.05
    assert value != np.float32(value)
    assert cost.evaluate(np.eye(4)[None])[0] == pytest.approx(abs(value), rel=1e-14)


def test_tolerance_zero_charges_every_free_point_inside_of_the_object():
    stream = np.random.default_rng(11)
    sdf, free = grid_of("sphere"), stream.uniform(-0.08, 0.08, (500, 3))
    changes = CostSettings(penetration_tolerance=0.0, lookup="nearest")
    nodes = np.rint(free / 0.01) * 0.01
    depth = np.maximum(0.05 - np.sqrt((nodes**2).sum(axis=1)), 0.0)
    cost = CompiledCost(sdf, KnownPoints(free), changes).evaluate(np.eye(4)[None])
    np.testing.assert_allclose(cost, 20.0 * depth.sum(), rtol=1e-12)


def test_tolerance_deeper_than_the_object_is_a_warning_and_costs_free_points_nothing():
    changes = CostSettings(penetration_tolerance=-0.2)
    free = np.random.default_rng(12).uniform(-0.05, 0.05, (100, 3))
    for made in (RelaxedCost, CompiledCost):
        with pytest.warns(UserWarning, match="cannot be violated"):
            cost = made(grid_of("box"), KnownPoints(free), changes)
    assert cost.evaluate(np.eye(4)[None])[0] == 0.0
    objective = Objective(cost, SE3Space())
    vectors = SE3Space().encode(Poses.of(np.eye(4)[None]))
    assert_same_bits(objective.descended(vectors, 1.0, 0.01, 5), vectors)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CompiledCost(grid_of("box"), KnownPoints(known=free), changes)


@pytest.mark.filterwarnings("ignore:.*cannot be violated")
@pytest.mark.parametrize("cost", [CompiledCost, RelaxedCost])
def test_an_interior_term_without_interior_points_says_what_to_do(cost):
    changes = CostSettings(free_term="interior", penetration_tolerance=-0.2)
    with pytest.raises(SettingError, match="penetration_tolerance nearer to 0"):
        cost(grid_of("box"), KnownPoints([[0.0, 0.0, 0.0]]), changes)


def test_free_voxels_that_span_too_much_are_an_error():
    changes = CostSettings(free_term="interior")
    with pytest.raises(SettingError, match="coarser free_resolution"):
        CompiledCost(grid_of("box"), KnownPoints([[0.0, 0.0, 0.0], [1e9, 1e9, 1e9]]), changes)


@pytest.mark.parametrize("cost", [CompiledCost, RelaxedCost])
def test_transforms_of_another_shape_are_refused(cost):
    sdf = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), 0.01)
    made = cost(sdf, KnownPoints(known=np.zeros((1, 3))))
    with pytest.raises(PoseError, match=r"has shape \(4, 4\); accepted: \(any, 4, 4\)"):
        made.evaluate(np.eye(4))
