"""The octree of points, and distances to a region, against brute force."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import PointsError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Region, box_of, clearance_of
from chsel.numerics.octree import Tree, candidates_for, octree, walk

STAY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def scattered(stream: np.random.Generator, count: int) -> FloatArray:
    return stream.uniform(-0.2, 0.2, (count, 3))


def on_a_lattice(stream: np.random.Generator, count: int) -> FloatArray:
    return np.rint(stream.uniform(-8.0, 8.0, (count, 3))) * 0.02 + 0.003


def in_a_plane(stream: np.random.Generator, count: int) -> FloatArray:
    return scattered(stream, count) * [1.0, 1.0, 0.0]


def all_the_same(stream: np.random.Generator, count: int) -> FloatArray:
    return np.tile(stream.uniform(-0.2, 0.2, (1, 3)), (count, 1))


def in_clusters_far_apart(stream: np.random.Generator, count: int) -> FloatArray:
    return scattered(stream, count) * 0.1 + 1e6 * stream.integers(0, 2, (count, 3))


KINDS = [scattered, on_a_lattice, in_a_plane, all_the_same, in_clusters_far_apart]
Kind = Callable[[np.random.Generator, int], FloatArray]


@st.composite
def sets_of_points(draw: st.DrawFn) -> FloatArray:
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.sampled_from([1, 2, 3, 9, 64, 65, 500, 4000]))
    return draw(st.sampled_from(KINDS))(stream, count)


def nodes_of(tree: Tree) -> int:
    return len(tree.starts) - 1


def children(tree: Tree, node: int) -> range:
    return range(tree.starts[node], tree.starts[node + 1])


def points_below(tree: Tree) -> list[list[int]]:
    """The points below every node, found by following children down."""
    nodes = nodes_of(tree)
    below: list[list[int]] = [[] for _ in range(nodes)]
    for node in range(nodes - 1, -1, -1):
        for child in children(tree, node):
            below[node] += [child - nodes] if child >= nodes else below[child]
    return below


@settings(max_examples=60, deadline=None)
@given(points=sets_of_points())
def test_order_is_a_permutation_and_the_last_level_is_the_points_in_it(points: FloatArray) -> None:
    tree = octree(points, 0.02)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(len(points)))
    np.testing.assert_array_equal(tree.spheres[:3, nodes_of(tree) :].T, points[tree.order])
    np.testing.assert_array_equal(tree.spheres[3, nodes_of(tree) :], 0.0)


@settings(max_examples=60, deadline=None)
@given(points=sets_of_points())
def test_every_node_of_a_level_has_one_parent_above_and_every_point_one_leaf(
    points: FloatArray,
) -> None:
    tree = octree(points, 0.02)
    nodes, levels = nodes_of(tree), tree.levels.tolist()
    ends = [*levels[1:], nodes + len(points)]
    assert levels[0] == 0
    assert levels[-1] == nodes
    assert (np.diff(tree.starts) >= 1).all()
    for level in range(len(levels) - 1):
        below = [
            child
            for node in range(levels[level], levels[level + 1])
            for child in children(tree, node)
        ]
        assert below == list(range(levels[level + 1], ends[level + 1]))
    assert levels[1] <= 64 or len(levels) > 2


@settings(max_examples=60, deadline=None)
@given(points=sets_of_points())
def test_spheres_hold_their_points_and_are_not_much_larger(points: FloatArray) -> None:
    tree = octree(points, 0.02)
    places = tree.spheres[:3, nodes_of(tree) :].T
    margin = 1e-9 + 1e-12 * np.abs(points).max()
    for node, below in enumerate(points_below(tree)):
        centre, radius = tree.spheres[:3, node], tree.spheres[3, node]
        assert np.sqrt(((places[below] - centre) ** 2).sum(axis=1)).max() < radius
        box = np.ptp(places[below], axis=0)
        assert radius <= 0.5 * np.sqrt((box**2).sum()) * (1.0 + 1e-9) + 2.0 * margin


def test_leaves_are_small_in_the_mean_unless_points_coincide() -> None:
    stream = np.random.default_rng(0)
    for kind in (scattered, on_a_lattice, in_a_plane):
        points = np.unique(kind(stream, 5000), axis=0)
        tree = octree(points, 0.02)
        leaves = tree.levels[-1] - tree.levels[-2]
        assert 4.0 <= len(points) / leaves < 40.0
    same = octree(all_the_same(stream, 5000), 0.02)
    assert nodes_of(same) == 1


def test_points_in_one_finest_cell_stay_in_their_order_and_others_do_not_depend_on_it() -> None:
    stream = np.random.default_rng(1)
    centres = np.unique(on_a_lattice(stream, 300), axis=0)
    twins = np.repeat(centres, 3, axis=0) + np.tile([[0.0], [1e-5], [-1e-5]], (len(centres), 1))
    order = octree(twins, 0.02).order
    np.testing.assert_array_equal(order.reshape(-1, 3) % 3, np.tile([0, 1, 2], (len(centres), 1)))
    shuffle = stream.permutation(len(centres))
    first, second = octree(centres, 0.02), octree(centres[shuffle], 0.02)
    np.testing.assert_array_equal(centres[first.order], centres[shuffle][second.order])
    np.testing.assert_array_equal(first.spheres, second.spheres)


@numba.njit(error_model="numpy")
def walked(tree, region, move, slack, found):  # type: ignore[no-untyped-def]
    return walk(tree, region, move, slack, found)


def found_within(tree: Tree, region: Region, slack: float) -> IntArray:
    """Numbers in the tree's order of the points that a walk finds."""
    found = candidates_for(tree.spheres.shape[1])
    count = walked(tree, region, STAY, slack, found)
    numbers = found.kept[:count].astype(np.int64) - nodes_of(tree)
    places = tree.spheres[:3, nodes_of(tree) :]
    np.testing.assert_array_equal(
        np.stack([found.x, found.y, found.z])[:, :count], places[:, numbers]
    )
    return numbers


@st.composite
def regions(draw: st.DrawFn) -> tuple[Region, BoolArray]:
    """Cells of 2 cm, some of them set, around the origin; and which."""
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = tuple(stream.integers(4, 12, 3).tolist())
    cells = np.zeros(shape, dtype=bool)
    inner = cells[1:-2, 1:-2, 1:-2]
    inner[...] = stream.random(inner.shape) < draw(st.sampled_from([0.0, 0.01, 0.1, 0.7, 1.1]))
    box = box_of(np.full(3, -0.1), 0.02, shape, between=draw(st.booleans()))
    return Region(box, clearance_of(cells, 0.02)), cells


def cell_boxes(region: Region, index: IntArray) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corners of cells (C, 3)."""
    shift = 0.0 if region.box.between else -0.5
    lower = np.array(region.box.first) + (index + shift) * 0.02
    return lower, lower + 0.02


def gap(lower: FloatArray, upper: FloatArray, others: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Least distance of every box, or point, (P, 3) to any of other boxes (C, 3)."""
    apart = np.maximum(others[0][None] - upper[:, None], lower[:, None] - others[1][None])
    distances: FloatArray = np.sqrt((np.maximum(apart, 0.0) ** 2).sum(axis=-1)).min(axis=1)
    return distances


@settings(max_examples=60, deadline=None)
@given(drawn=regions())
def test_clearance_is_the_distance_between_cells_as_boxes_or_less(
    drawn: tuple[Region, BoolArray],
) -> None:
    region, cells = drawn
    clearance = region.clearance.reshape(cells.shape).astype(float)
    if not cells.any():
        assert np.isinf(clearance).all()
        return
    np.testing.assert_array_equal(clearance[cells], -1.0)
    others = np.argwhere(~cells)
    true = gap(*cell_boxes(region, others), cell_boxes(region, np.argwhere(cells)))
    found = np.sqrt(clearance[~cells])
    assert (found <= true).all()
    np.testing.assert_allclose(found, true, atol=0.013)  # it rounds a corner, so not always equal
    np.testing.assert_allclose(found[true == 0.0], 0.0)


@settings(max_examples=100, deadline=None)
@given(drawn=regions(), points=sets_of_points(), slack=st.sampled_from([0.0, 0.005, 0.03, np.inf]))
def test_a_walk_finds_every_point_within_the_slack_in_the_order_of_the_tree(
    drawn: tuple[Region, BoolArray], points: FloatArray, slack: float
) -> None:
    region, cells = drawn
    tree = octree(points, 0.02)
    found = found_within(tree, region, slack)
    assert (np.diff(found) > 0).all()
    if not cells.any():
        assert len(found) == (0 if np.isfinite(slack) else len(points))
        return
    places = points[tree.order]
    distances = gap(places, places, cell_boxes(region, np.argwhere(cells)))
    wanted = np.flatnonzero(distances <= (slack - 1e-9 if slack > 0.0 else -1.0))
    inside = np.flatnonzero(distances < 1e-9)
    deep = inside[np.isin(inside, np.flatnonzero(well_inside(region, cells, places)))]
    assert np.isin(wanted, found).all()
    assert np.isin(deep, found).all()
    if np.isinf(slack):
        np.testing.assert_array_equal(found, np.arange(len(points)))
    else:
        assert (distances[found] <= 1.5 * slack + 0.06).all()  # and not many others


def well_inside(region: Region, cells: BoolArray, places: FloatArray) -> BoolArray:
    """Whether points are in a set cell, and farther than rounding goes from its border."""
    lower, upper = cell_boxes(region, np.argwhere(cells))
    above = (places[:, None] > lower[None] + 1e-9).all(axis=-1)
    below = (places[:, None] < upper[None] - 1e-9).all(axis=-1)
    inside: BoolArray = (above & below).any(axis=1)
    return inside


def test_a_walk_finds_few_points_about_a_small_region() -> None:
    """Those in the cell that is set and in its neighbours, 27 in all, and no others."""
    cells = np.zeros((11, 11, 11), dtype=bool)
    cells[5, 5, 5] = True
    region = Region(box_of(np.full(3, -0.1), 0.02, cells.shape), clearance_of(cells, 0.02))
    points = scattered(np.random.default_rng(2), 20_000)
    tree = octree(points, 0.01)
    found = found_within(tree, region, 0.0)
    inside = (np.abs(points[tree.order]) < 0.01).all(axis=1)
    assert inside.sum() > 0
    assert np.isin(np.flatnonzero(inside), found).all()
    assert len(found) < 30 * inside.sum()


def test_no_points_make_an_empty_tree() -> None:
    tree = octree(np.zeros((0, 3)), 0.02)
    cells = np.ones((3, 3, 3), dtype=bool)
    region = Region(box_of(np.zeros(3), 0.02, cells.shape), clearance_of(cells, 0.02))
    assert nodes_of(tree) == 0
    assert len(found_within(tree, region, np.inf)) == 0


@pytest.mark.parametrize("far", [1e9, 1e200])
def test_points_far_apart_are_told_apart(far: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [far, 0.0, 0.0], [0.0, -far, far], [0.01, 0.0, 0.0]])
    tree = octree(points, 0.01)
    assert sorted(tree.order.tolist()) == [0, 1, 2, 3]
    np.testing.assert_array_equal(tree.spheres[:3, nodes_of(tree) :].T, points[tree.order])


def test_points_whose_distance_is_no_number_are_refused() -> None:
    with pytest.raises(PointsError, match="accepted: a finite extent"):
        octree(np.array([[-1.5e308, 0.0, 0.0], [1.5e308, 0.0, 0.0]]), 0.01)
