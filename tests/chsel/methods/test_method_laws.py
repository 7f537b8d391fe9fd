"""Laws of registration: what another frame, order, weight, seed or point may change of a result."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import chsel
from chsel.cost.cost_settings import CostSettings
from chsel.methods import METHODS
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, compose, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.laws import every_method, quick
from tests.chsel.methods.scene import GRID, MESH, POINTS, SIDE, TRUTH, WORKSPACE, around_truth

DRAWS_POSES = ("chsel", "chsel_cma_me", "medial_constraint", "medial_constraint_cma_me", "anchored")
"""Methods that draw poses in coordinates of the world, so that not all of them move with it."""
DRAWS_CONTACTS = ("chsel-default", "chsel_cma_me-default", "anchored")
"""Those that draw contacts by their place in the list, on which poses are put."""
GIVEN_STARTS = ("gradient_descent", "svgd", "cvo", "cvo_no_free_space")
"""Methods that draw nothing: all follows from E_0."""
SAME = 1e-9
"""Of entries of poses: results that differ by the rounding of other numbers alone."""

FEW = KnownPoints(free=POINTS.free[::110], known=POINTS.known)
PROBLEM = RegistrationProblem(
    sdf=GRID,
    points=FEW,
    initial_set=around_truth(8, 0.1, shift=0.01),
    workspace=WORKSPACE,
    free_resolution=SIDE,
    key=StreamKey(5, 1),
)


@cache
def result(name, preset):
    """What a method finds in PROBLEM."""
    return quick(name, preset).register(PROBLEM)


def assert_same(found, expected, *, all_of_them):
    """The same poses but for rounding; of a set that is drawn, the best alone."""
    count = None if all_of_them else 1
    poses, others = found.object_from_world[:count], expected.object_from_world[:count]
    np.testing.assert_allclose(poses, others, rtol=0, atol=SAME if all_of_them else 1e-7)


@every_method
def test_poses_turn_with_the_world(name, preset):
    """By a quarter turn, which leaves the sides of the workspace along the axes.

    Descents in coordinates of poses turn with it; by another angle or a shift their steps differ.
    """
    turn = compose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    corners = apply(turn, np.array(WORKSPACE.bounds))
    problem = replace(
        PROBLEM,
        points=KnownPoints(free=apply(turn, FEW.free), known=apply(turn, FEW.known)),
        initial_set=PROBLEM.initial_set @ inverse(turn),
        workspace=Workspace(tuple(corners.min(axis=0)), tuple(corners.max(axis=0))),
    )
    found = quick(name, preset).register(problem)
    back = replace(found, object_from_world=found.object_from_world @ turn)
    expected = result(name, preset)
    if name not in DRAWS_POSES:
        assert_same(back, expected, all_of_them=True)
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-6, atol=1e-9)
    elif name == "anchored":
        assert_same(back, expected, all_of_them=False)
    else:
        judge = quick("gradient_descent", descent={"restarts": 0}, online={"hypotheses": 8})
        costs = [
            judge.register(replace(p, initial_set=f.object_from_world)).cost
            for p, f in ((problem, found), (PROBLEM, back))
        ]
        np.testing.assert_allclose(costs[0], costs[1], rtol=1e-6, atol=1e-9)


@every_method
def test_the_order_of_points_does_not_matter(name, preset):
    random = np.random.default_rng(0)
    points = KnownPoints(free=random.permutation(FEW.free), known=random.permutation(FEW.known))
    found = quick(name, preset).register(replace(PROBLEM, points=points))
    drawn = f"{name}-{preset}".startswith(DRAWS_CONTACTS)
    assert_same(found, result(name, preset), all_of_them=not drawn)


def with_normals(points, world_from_object=TRUTH):
    """The points with the normals of the L at some pose; every fifth has none."""
    gradients = GRID.at(apply(inverse(world_from_object), points.known), lookup="trilinear")[1]
    normals = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    known = np.arange(len(normals)) % 5 > 0
    return replace(
        points,
        normals=known[:, None] * normals @ world_from_object[:3, :3].T,
        normal_noise=np.where(known, np.linspace(0.1, 0.3, len(known)), 0.0),
    )


def test_normals_turn_with_the_world_and_go_with_their_points():
    """By any order and a quarter turn, of the best pose and its cost; draws end a little apart."""

    def assert_alike(found):
        poses = found.object_from_world[0], expected.object_from_world[0]
        np.testing.assert_allclose(*poses, rtol=0, atol=1e-3)
        assert found.cost[0] == pytest.approx(expected.cost[0], abs=0.1)

    few = with_normals(FEW.with_known(slice(12)))
    problem = replace(PROBLEM, points=replace(few, free=FEW.free[:0]))
    expected = quick("anchored").register(problem)
    order = np.random.default_rng(0).permutation(12)
    permuted = replace(problem, points=problem.points.with_known(order))
    assert_alike(quick("anchored").register(permuted))
    normals = {"normals": few.normals[order], "normal_noise": few.normal_noise[order]}
    mixed = replace(problem, points=replace(problem.points, **normals))
    assert quick("anchored").register(mixed).cost[0] > expected.cost[0] + 10.0
    turn = compose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    corners = apply(turn, np.array(WORKSPACE.bounds))
    points = KnownPoints(
        known=apply(turn, few.known),
        normals=few.normals @ turn[:3, :3].T,
        normal_noise=few.normal_noise,
    )
    moved = replace(
        problem,
        points=points,
        initial_set=PROBLEM.initial_set @ inverse(turn),
        workspace=Workspace(tuple(corners.min(axis=0)), tuple(corners.max(axis=0))),
    )
    found = quick("anchored").register(moved)
    assert_alike(replace(found, object_from_world=found.object_from_world @ turn))


@pytest.mark.parametrize("name", [name for name in METHODS if name != "anchored"])
def test_other_methods_read_neither_normals_nor_a_prior(name):
    prior = chsel.PosePrior(centre=[0.1, 0.1, 0.1], centre_noise=0.001)
    problem = replace(PROBLEM, points=with_normals(FEW), prior=prior)
    assert quick(name).register(problem).digest == result(name, "default").digest


@every_method
def test_contacts_that_count_twice_are_those_of_twice_the_weight(name, preset):
    """Costs that are means, or matches of each contact, stay as they are.

    `cvo` compares whole clouds, in which free points then weigh half as much.
    """
    points = FEW.with_known(np.repeat(np.arange(len(FEW.known)), 2))
    method = quick(name, preset)
    found = method.register(replace(PROBLEM, points=points))
    cost = getattr(method.settings, "cost", None)
    expected = result(name, preset)
    if isinstance(cost, CostSettings):
        doubled = settings_mapping(cost) | {"known_scale": 2.0 * cost.known_scale}
        expected = quick(name, preset, cost=doubled).register(PROBLEM)
    if name == "cvo":
        assert np.abs(found.object_from_world - expected.object_from_world).max() > 0.01
        return
    drawn = f"{name}-{preset}".startswith(DRAWS_CONTACTS)
    assert_same(found, expected, all_of_them=not drawn)


@every_method
def test_free_points_that_the_object_cannot_reach_change_no_bit(name, preset):
    """But for `cvo`, whose cost is by the size of the whole cloud."""
    far = replace(FEW, free=np.concatenate([FEW.free, FEW.free + np.array([5.0, 0.0, 0.0])]))
    found = quick(name, preset).register(replace(PROBLEM, points=far))
    assert (found.digest == result(name, preset).digest) is (name != "cvo")


@every_method
def test_another_seed_is_another_draw_and_the_same_one_the_same_bits(name, preset):
    method = quick(name, preset)
    assert method.register(PROBLEM).digest == result(name, preset).digest
    other = method.register(replace(PROBLEM, key=StreamKey(4, 1)))
    assert (other.digest == result(name, preset).digest) is (name in GIVEN_STARTS)


@every_method
def test_points_in_millimetres_are_refused_before_anything_is_searched(name, preset):
    with pytest.raises(chsel.ChselError, match="millimetres") as caught:
        chsel.register(GRID, contacts=1000.0 * FEW.known, method=name, preset=preset)
    assert "\n" not in str(caught.value)


def test_a_mesh_in_millimetres_is_one_in_metres_by_its_scale(tmp_path):
    millimetres = MESH.copy().apply_scale(1000.0)
    millimetres.export(tmp_path / "part.ply")
    mesh = chsel.load_mesh(tmp_path / "part.ply", scale=0.001)
    sdf = chsel.SdfGrid.from_mesh(mesh, 0.01)
    assert sdf.values.shape == GRID.values.shape
    np.testing.assert_allclose(sdf.values, GRID.values, atol=1e-6)
