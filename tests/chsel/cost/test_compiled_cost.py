"""The compiled cost against the torch cost, and its own bits against themselves."""

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
from chsel.problem.settings import in_preset
from tests.chsel.samples import ball_grid, decode, random_poses

pytestmark = pytest.mark.filterwarnings("ignore:free_term interior uses")
BOX_SIDES = (0.12, 0.08, 0.06)
FREE_TERMS = pytest.mark.parametrize("free_term", ["direct", "interior"])


@cache
def grid_of(name):
    if name == "sphere":
        return ball_grid(0.05, 0.01, half=9)
    if name == "box":
        return SdfGrid.from_mesh(trimesh.creation.box(BOX_SIDES), 0.006, padding=0.03)
    if name == "dyadic":  # a grid whose nodes and borders are exact numbers
        return ball_grid(0.07, 2.0**-6, half=8)
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
    space: SearchSpace = SE3Space()  # noqa: RUF009

    def cost(self, made=CompiledCost, **options):
        resolution = self.free_resolution
        sdf = grid_of(self.shape)
        return made(sdf, self.points, settings=self.settings, free_resolution=resolution, **options)

    def objective(self, culling="octree"):
        return Objective(self.cost(culling=culling), self.space)


def posed(transforms):
    return SE3Space().encode(Poses.of(transforms))


@st.composite
def cases(draw):
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.sampled_from(["sphere", "box", "l_shape"]))
    resolution = draw(st.sampled_from([0.01, 0.022, 0.03]))
    count = draw(st.sampled_from([0, 1, 2, 9, 100, 3000]))
    free = stream.uniform(-0.15, 0.15, (count, 3))
    kind = draw(st.sampled_from(["anywhere", "anywhere", "lattice", "line", "one", "far"]))
    if kind == "lattice":
        free = np.unique(np.rint(free / resolution), axis=0) * resolution
    free = free * [1.0, 0.0, 0.0] if kind == "line" else free
    free = np.tile(0.1 * free[:1], (len(free), 1)) if kind == "one" else free
    free = free + 10.0 if kind == "far" else free
    known = stream.uniform(-0.15, 0.15, (draw(st.integers(0, 12)), 3))
    free_term = draw(st.sampled_from(["direct", "interior"]))
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
    points = KnownPoints(
        free, occupied, known=known, known_sdf=stream.uniform(-0.03, 0.03, len(known))
    )
    count = draw(st.integers(1, 9))
    reach = draw(st.sampled_from([0.03, 0.1, 0.4]))
    space = SE3Space()
    if draw(st.integers(0, 3)) == 0:
        axis = tuple(stream.standard_normal(3).tolist())
        space = SE2Space(PlaneSettings(axis=axis, offset=0.01), grid_of(shape))
    vectors = space.encode(Poses.of(random_poses(stream, count, reach=reach)))
    if space.dimension == 9:  # raw vectors are not orthonormal
        vectors[:, :6] += stream.uniform(-0.2, 0.2, (count, 6))
    return Case(
        shape, points, settings=changes, free_resolution=resolution, vectors=vectors, space=space
    )


def assert_equals_torch(case):
    leaves = torch.tensor(case.vectors, requires_grad=True)
    values = case.cost(RelaxedCost)(*decode(case.space, leaves))
    values.sum().backward()
    values = values.detach().numpy()
    gradients = leaves.grad.numpy()
    found, slopes = case.objective().costs_and_gradients(case.vectors)
    np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-14)
    size = 1.0 + np.abs(gradients).max(axis=1, keepdims=True)
    np.testing.assert_allclose(slopes / size, gradients / size, rtol=0.0, atol=1e-12)


def assert_same_bits(first, second):
    for one, other in zip(np.atleast_1d(first), np.atleast_1d(second), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        assert one.shape == other.shape
        np.testing.assert_array_equal(one.view(np.int64), other.view(np.int64))


@settings(max_examples=100, deadline=None)
@given(case=cases())
def test_costs_and_gradients_are_those_of_the_torch_cost(case):
    assert_equals_torch(case)


@settings(max_examples=60, deadline=None)
@given(case=cases())
def test_culling_batches_threads_and_gradients_change_no_bit(case):
    objective = case.objective()
    vectors = case.vectors
    costs, gradients = objective.costs_and_gradients(vectors)
    assert_same_bits(costs, objective.costs(vectors))
    others = [case.objective("none").costs_and_gradients(vectors)]
    for count in (2, 3):
        with threads(count):
            others.append(objective.costs_and_gradients(vectors))
            assert_same_bits(objective.costs(vectors), costs)
    alone = [objective.costs_and_gradients(vector[None].copy()) for vector in vectors]
    others.append([np.concatenate(parts) for parts in zip(*alone, strict=True)])
    for other_costs, other_gradients in others:
        assert_same_bits(costs, other_costs)
        assert_same_bits(gradients, other_gradients)


def descended_plainly(objective, vectors, *, divisor, rate, iterations):
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


def descends_plainly(case, divisor, *, rate, iterations):
    """Where a descent ends, which is where one without neighbour lists does."""
    plain = descended_plainly(
        case.objective("none"), case.vectors, divisor=divisor, rate=rate, iterations=iterations
    )
    ends = case.objective().descended(case.vectors, divisor, rate=rate, iterations=iterations)
    assert_same_bits(ends, plain)
    return plain


@settings(max_examples=60, deadline=None)
@given(case=cases(), rate=st.sampled_from([1e-4, 1e-3, 0.01, 0.1, 1.0]))
def test_descent_with_neighbour_lists_is_to_the_bit_descent_over_all_points(case, rate):
    plain = descends_plainly(case, 3.0, rate=rate, iterations=40)
    objective = case.objective()
    with threads(2):
        assert_same_bits(objective.descended(case.vectors, 3.0, rate=rate, iterations=40), plain)
        assert_same_bits(
            objective.descended(case.vectors[:1].copy(), 3.0, rate=rate, iterations=40), plain[:1]
        )


class Turntable(SE2Space):
    """A plane on which the object can only turn."""

    def __init__(self, sdf):
        super().__init__(PlaneSettings(offset=0.0), sdf)
        self.arrays = self.arrays._replace(e_u=(0.0, 0.0, 0.0), e_v=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("free_term", "turn"), [("direct", 0.004), ("direct", 0.1), ("interior", 0.02)]
)
def test_an_object_that_turns_misses_none_of_the_points_that_it_sweeps(free_term, turn):
    """Contacts far away turn it by about `turn` radians a step, at first."""
    free = np.random.default_rng(14).uniform(-0.2, 0.2, (100_000, 3)) * [1.0, 1.0, 0.2]
    points = KnownPoints(free, known=[[0.0, 3.0, 0.0], [0.1, -3.0, 0.0]])
    changes = CostSettings(free_term=free_term, known_scale=1e6)
    vectors = np.zeros((3, 3))
    vectors[:, 0] = np.arange(3) * 1.6
    shape = "fine l_shape" if free_term == "direct" else "l_shape"
    case = Case(
        shape,
        points,
        settings=changes,
        free_resolution=0.005,
        vectors=vectors,
        space=Turntable(grid_of("l_shape")),
    )
    plain = descends_plainly(case, 1.0, rate=turn, iterations=20)
    assert (np.abs(plain[:, 0] - vectors[:, 0]) > 5.0 * turn).any()


def test_an_object_that_comes_into_free_space_from_outside_misses_none_of_its_points():
    """A corner of a box comes first, where a sphere around the box fits it best."""
    corner = np.array(BOX_SIDES) / 2.0
    x = corner / np.linalg.norm(corner)
    y = np.cross(x, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(x, [0.0, 0.0, 1.0]))
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)  # its columns are the world's axes
    away = np.linalg.norm(corner) + np.arange(0.0, 0.05, 0.003)
    vectors = posed(compose(np.tile(rotation, (len(away), 1, 1)), away[:, None] * x))
    free = np.random.default_rng(17).uniform([0.0, -0.05, -0.05], [0.2, 0.05, 0.05], (20_000, 3))
    points = KnownPoints(free, known=[[1.0, 0.0, 0.0], [1.0, 0.1, 0.0]])
    case = Case(
        "box",
        points,
        settings=CostSettings(penetration_tolerance=0.0),
        free_resolution=0.005,
        vectors=vectors,
    )
    for rate in (0.002, 0.005):
        plain = descends_plainly(case, 1.0, rate=rate, iterations=20)
    free_alone = replace(case, points=KnownPoints(free=free)).objective("none")
    assert not free_alone.costs(vectors)[1:].any()
    assert (free_alone.costs(plain) > 0.0).sum() > 5


def test_by_default_alpha_is_a_quarter_of_a_free_voxel_or_half_of_the_greatest_depth():
    sdf = grid_of("sphere")  # 5 cm deep
    for resolution, alpha in ((0.02, -0.005), (0.4, -0.025)):
        assert CostSettings().of_object(sdf, resolution).alpha == pytest.approx(alpha)
    assert [in_preset(CostSettings(), name).alpha for name in ("paper", "reference")] == [-0.01] * 2


ON_LATTICE = ((np.argwhere(np.ones((59, 59, 59))) - 29) * 0.005)[:200_000]
SCATTERED = np.random.default_rng(3).uniform(-0.2, 0.2, (200_000, 3))


@pytest.mark.parametrize(
    ("free", "lookup"), [(ON_LATTICE, "nearest"), (ON_LATTICE, "trilinear"), (SCATTERED, "nearest")]
)
def test_200_000_free_points_cost_to_the_bit_what_they_cost_without_culling(free, lookup):
    transforms = random_poses(np.random.default_rng(4), 5, reach=0.2)
    transforms[0] = np.eye(4)
    poses = Poses.of(transforms)
    case = Case(
        "l_shape",
        KnownPoints(free=free),
        settings=CostSettings(lookup=lookup),
        free_resolution=0.005,
        vectors=posed(transforms),
    )
    costs = case.cost().costs(poses)
    assert costs[0] > 1.0
    assert_same_bits(costs, case.cost(culling="none").costs(poses))


def border_points(sdf):
    """Nodes, middles between them, corners of the grid, and the numbers next to all of these."""
    stream = np.random.default_rng(5)
    (first, last) = sdf.bounds
    nodes = stream.integers(0, np.array(sdf.shape), (300, 3))
    halves = nodes - 0.5 * stream.integers(0, 2, (300, 3))
    points = [first + halves * sdf.resolution]
    corners = np.where(np.indices((2, 2, 2)).reshape(3, -1).T == 0, first, last)
    faces = np.where(stream.integers(0, 2, (60, 3)) == 0, corners[stream.integers(0, 8, 60)], 0.01)
    exact = np.concatenate([*points, corners, faces])
    return np.concatenate([exact, np.nextafter(exact, -np.inf), np.nextafter(exact, np.inf)])


@pytest.mark.parametrize("outside", ["surface_point", "bounding_box"])
@pytest.mark.parametrize(
    ("lookup", "gradient"),
    [("nearest", "defined"), ("trilinear", "defined"), ("trilinear", "exact")],
)
def test_points_on_borders_of_voxels_and_of_the_grid_read_what_the_torch_cost_reads(
    lookup, outside, gradient
):
    sdf = grid_of("dyadic")
    changes = CostSettings(lookup=lookup, outside=outside, gradient=gradient)
    turns = np.array(
        [np.eye(3), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    )
    shifts = np.array([[0, 0, 0], [0.5, -1.0, 2.0], [2.0**-7, 0, 2.0**-6]])
    vectors = posed(compose(turns, shifts))
    for n in range(len(shifts)):
        # exact but for the numbers next to others
        world = (border_points(sdf) - shifts[n]) @ turns[n]
        for points in (
            KnownPoints(free=world),
            KnownPoints(occupied=world),
            KnownPoints(known=world),
        ):
            one = vectors[n : n + 1].copy()
            assert_equals_torch(
                Case(
                    "dyadic", points, settings=changes, free_resolution=sdf.resolution, vectors=one
                )
            )


def test_free_voxels_are_read_on_their_borders_as_the_torch_cost_reads_them():
    step = 2.0**-6
    free = np.array([[0.0, 0.0, 0.0], [step, 0.0, 0.0], [0.0, 2 * step, step], [3 * step, 0, 0]])
    changes = CostSettings(free_term="interior", interior_spacing=0.5 * step)
    shifts = step * np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.25], [1.5, -1.0, 2.5]])
    vectors = posed(compose(np.tile(np.eye(3), (3, 1, 1)), shifts))
    case = Case(
        "dyadic", KnownPoints(free=free), settings=changes, free_resolution=step, vectors=vectors
    )
    assert case.objective().costs(vectors)[0] > 0.0
    assert_equals_torch(case)


@FREE_TERMS
@pytest.mark.parametrize("far", [6.4e6, 1e9])
def test_a_scene_far_from_the_origin_is_culled_without_loss(far, free_term):
    """At 1e9 m, neighbouring doubles are 0.1 micrometres apart."""
    stream = np.random.default_rng(8)
    shift = np.array([far, -far, 0.5 * far])
    free = np.rint(stream.uniform(-8.0, 8.0, (400, 3))) * 0.01 + shift
    turns = random_rotations(stream, 6)
    turns[0] = np.eye(3)
    vectors = posed(compose(turns, -(turns @ shift) + stream.uniform(-0.03, 0.03, (6, 3))))
    points = KnownPoints(free, known=free[:9] + 0.01)
    case = Case(
        "box",
        points,
        settings=CostSettings(free_term=free_term),
        free_resolution=0.01,
        vectors=vectors,
    )
    costs = case.objective().costs(vectors)
    assert (costs[1:] > 0.0).any()
    assert_same_bits(costs, case.objective("none").costs(vectors))
    descends_plainly(case, 1.0, rate=1e-3, iterations=30)


@FREE_TERMS
@pytest.mark.parametrize("bad", [np.nan, 1e300])
def test_a_pose_that_is_not_finite_leaves_the_lanes_beside_it_to_the_bit_as_they_are(
    bad, free_term
):
    stream = np.random.default_rng(16)
    near = stream.uniform(-0.1, 0.1, (900, 3))
    points = KnownPoints(near, near[:3], known=near[:9])
    vectors = posed(random_poses(stream, LANES, reach=0.02))
    changes = CostSettings(free_term=free_term, lookup="nearest")
    objective = Case(
        "l_shape", points, settings=changes, free_resolution=0.02, vectors=vectors
    ).objective()
    costs, slopes = objective.costs_and_gradients(vectors)
    moved = objective.descended(vectors, 3.0, rate=0.01, iterations=20)
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
        assert_same_bits(
            objective.descended(spoiled, 3.0, rate=0.01, iterations=20)[others], moved[others]
        )


@pytest.mark.parametrize("made", [RelaxedCost, CompiledCost])
def test_tolerance_deeper_than_the_object_is_a_warning_and_costs_free_points_nothing(made):
    changes = CostSettings(penetration_tolerance=-0.2)
    free = np.random.default_rng(12).uniform(-0.05, 0.05, (100, 3))
    with pytest.warns(UserWarning, match="cannot be violated"):
        cost = made(grid_of("box"), KnownPoints(free=free), settings=changes)
    assert cost.evaluate(np.eye(4)[None])[0] == 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made(grid_of("box"), KnownPoints(known=free), settings=changes)


@pytest.mark.filterwarnings("ignore:.*cannot be violated")
@pytest.mark.parametrize("made", [CompiledCost, RelaxedCost])
def test_what_has_no_cost_says_what_is_accepted(made):
    sdf = grid_of("box")
    free = KnownPoints(free=[[0.0, 0.0, 0.0]])
    interior = CostSettings(free_term="interior")
    with pytest.raises(SettingError, match="penetration_tolerance nearer to 0"):
        made(sdf, free, settings=replace(interior, penetration_tolerance=-0.2))
    with pytest.raises(SettingError, match="coarser free_resolution"):
        made(sdf, KnownPoints(free=[[0.0, 0.0, 0.0], [1e9, 1e9, 1e9]]), settings=interior)
    with pytest.raises(PoseError, match=r"has shape \(4, 4\); accepted: \(any, 4, 4\)"):
        made(sdf, free).evaluate(np.eye(4))
