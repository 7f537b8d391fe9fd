"""The tree of points, and what it finds near a set of cells, against brute force."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.numerics.cell_set import box_of, cell_set_of, squared_clearances
from chsel.numerics.near_points import LANES, gather, near_points_for, point_tree, select, to_cells

STAY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def scattered(stream, count):
    return stream.uniform(-0.2, 0.2, (count, 3))


def on_a_lattice(stream, count):
    return np.rint(stream.uniform(-8.0, 8.0, (count, 3))) * 0.02 + 0.003


KINDS = [
    scattered,
    on_a_lattice,
    lambda stream, count: scattered(stream, count) * [1.0, 1.0, 0.0],  # in a plane
    lambda stream, count: np.tile(scattered(stream, 1), (count, 1)),  # all the same
    lambda stream, count: (  # in clusters far apart
        scattered(stream, count) * 0.1 + 10.0 * stream.integers(0, 2, (count, 3))
    ),
]


@st.composite
def sets_of_points(draw):
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.sampled_from([0, 1, 2, 3, 9, 64, 65, 500, 4000]))
    return draw(st.sampled_from(KINDS))(stream, count)


def test_points_in_one_finest_cell_stay_in_their_order_and_others_do_not_depend_on_it():
    stream = np.random.default_rng(1)
    centres = np.unique(on_a_lattice(stream, 300), axis=0)
    twins = np.repeat(centres, 3, axis=0) + np.tile([[0.0], [1e-5], [-1e-5]], (len(centres), 1))
    order = point_tree(twins, 0.02).order
    np.testing.assert_array_equal(order.reshape(-1, 3) % 3, np.tile([0, 1, 2], (len(centres), 1)))
    shuffle = stream.permutation(len(centres))
    first = point_tree(centres, 0.02)
    second = point_tree(centres[shuffle], 0.02)
    np.testing.assert_array_equal(centres[first.order], centres[shuffle][second.order])


@numba.njit(error_model="numpy")
def fill_hits(tree, cells, move, slack, near):
    """How many points are gathered, then how many of these are selected into hits."""
    to_cell, rounding = to_cells(tree, cells.box, move)
    gather(tree, cells, to_cell, slack + rounding, near, 0)
    return rounding, near.number[0], select(tree, cells, to_cell, rounding, near, 0)


def found_in(tree, cells, *, slack):
    """Numbers in the tree's order: the points of packets within a slack, and those in the set."""
    near = near_points_for(tree, 1)
    rounding, packets, count = fill_hits(tree, cells, STAY, slack, near)
    assert 0.0 <= rounding < 1e-4
    firsts = tree.first[near.kept[:packets]]
    gathered = (firsts[:, None] + np.arange(LANES)).reshape(-1)
    return gathered[gathered < len(tree.order)], near.hits[:count].astype(np.int64)


@st.composite
def cell_sets(draw):
    """Cells of 2 cm, some of them set, around the origin; and which."""
    stream = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = tuple(stream.integers(4, 12, 3).tolist())
    cells = np.zeros(shape, dtype=bool)
    inner = cells[1:-2, 1:-2, 1:-2]
    inner[...] = stream.random(inner.shape) < draw(st.sampled_from([0.0, 0.01, 0.1, 0.7, 1.1]))
    box = box_of(np.full(3, -0.1), 0.02, shape=shape, between=draw(st.booleans()))
    return cell_set_of(box, cells), cells


def gap(cells, index, *, places):
    """Least distance of each point (P, 3) to any of the cells (C, 3)."""
    lower = np.array(cells.box.first) + (index - 0.5 + 0.5 * cells.box.between) * 0.02
    apart = np.maximum(lower[None] - places[:, None], places[:, None] - lower[None] - 0.02)
    return np.sqrt((np.maximum(apart, 0.0) ** 2).sum(axis=-1)).min(axis=1)


@settings(max_examples=100, deadline=None)
@given(drawn=cell_sets(), points=sets_of_points(), slack=st.sampled_from([0.0, 0.005, 0.03]))
def test_all_points_in_the_set_and_within_the_slack_are_found_and_few_others(drawn, points, slack):
    cells, flags = drawn
    tree = point_tree(points, 0.02)
    gathered, selected = found_in(tree, cells, slack=slack)
    if not flags.any() or len(points) == 0:
        assert len(selected) == 0
        return
    distances = gap(cells, np.argwhere(flags), places=points[tree.order])
    assert np.isin(np.flatnonzero(distances <= slack), gathered).all()
    assert np.isin(np.flatnonzero(distances == 0.0), selected).all()
    assert (np.diff(selected) > 0).all()
    steps = (tree.points.T - cells.box.first) / 0.02 + 0.5 - 0.5 * cells.box.between
    sure = (np.abs(steps - np.rint(steps)) > 1e-3).all(axis=1)  # 32 bits know their cells
    assert (distances[selected[sure[selected]]] == 0.0).all()


def test_few_points_are_gathered_about_a_small_set():
    cells = np.zeros((11, 11, 11), dtype=bool)
    cells[5, 5, 5] = True
    points = 0.25 * scattered(np.random.default_rng(2), 20_000)
    tree = point_tree(points, 0.0025)
    box = box_of(np.full(3, -0.1), 0.02, shape=cells.shape)
    gathered, selected = found_in(tree, cell_set_of(box, cells), slack=0.0)
    inside = (np.abs(points[tree.order]) < 0.01).all(axis=1).sum()
    assert 0 < inside <= len(selected) < 1.1 * inside + 1
    assert len(gathered) < 2 * 27 * inside  # neighbouring cells are 0 away, too


@pytest.mark.parametrize("gap", [1, 2])
@pytest.mark.parametrize("share", [0.0, 0.9, 0.998, 1.0])
def test_clearances_are_distances_to_the_nearest_voxel_outside(share, gap):
    stream = np.random.default_rng(int(1000.0 * share))
    inside = stream.random((7, 10, 13)) < share
    out = np.empty(inside.shape, dtype=np.int64)
    squared_clearances(inside, out, gap=gap)
    outside = np.argwhere(~inside)
    if len(outside) == 0:
        assert (out >= 2**60).all()
        return
    apart = np.abs(np.argwhere(inside | ~inside)[:, None] - outside[None])
    expected = (np.maximum(2 * apart - gap, 0) ** 2).sum(axis=-1).min(axis=1)
    np.testing.assert_array_equal(out.reshape(-1), expected)
