"""The walk through voxels, against exact rational arithmetic on coordinates full of ties."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.sensing.free_space import MarkedVoxels, mark_segments

COUNTS = (5, 4, 3)
LOWER = np.full(3, 0.5)  # so that voxel k is from k to k + 1

places = st.tuples(*[st.integers(-12, 32).map(lambda n: n / 4.0)] * 3)
Place = tuple[float, float, float]
Voxel = tuple[int, ...]


def marked(a: Place, b: Place) -> set[Voxel]:
    met = np.zeros(COUNTS, dtype=np.uint8)
    grid = MarkedVoxels(met.reshape(-1), COUNTS, LOWER, 1.0)
    mark_segments(grid, np.array([a]), np.array([b]), 0, 1)
    assert met.max() <= 1
    return {tuple(voxel) for voxel in np.argwhere(met).tolist()}


def overlap(voxel: Voxel, a: Place, b: Place) -> tuple[Fraction, bool]:
    """How much of the segment is in the voxel with its faces (below 0: none), and whether within
    it alone: not in a face that it shares with the next lower voxel."""
    enters, leaves, within = Fraction(0), Fraction(1), True
    for k, start, end in zip(voxel, map(Fraction, a), map(Fraction, b), strict=True):
        d = end - start
        if d == 0:
            if not k <= start <= k + 1:
                return Fraction(-1), False
            within &= start < k + 1
        else:
            crossings = sorted([(k - start) / d, (k + 1 - start) / d])
            enters, leaves = max(enters, crossings[0]), min(leaves, crossings[1])
    return leaves - enters, within


@settings(max_examples=150, deadline=None)
@given(a=places, b=places)
def test_all_voxels_that_are_passed_are_marked_and_none_that_is_not_touched(
    a: Place, b: Place
) -> None:
    found = marked(a, b)
    for voxel in np.ndindex(*COUNTS):
        inside, within = overlap(voxel, a, b)
        if inside > 0 and within:
            assert voxel in found
        if inside < 0:
            assert voxel not in found


@settings(max_examples=150, deadline=None)
@given(a=places, b=places)
def test_the_voxels_of_ends_inside_are_marked_and_all_are_joined(a: Place, b: Place) -> None:
    found = marked(a, b)
    for end in (a, b):
        inside = all(0.0 < x < count for x, count in zip(end, COUNTS, strict=True))
        assert not inside or tuple(int(x) for x in end) in found
    sums = np.array(sorted(found)).reshape(-1, 3)
    order = np.argsort(sums @ np.sign(np.array(b) - np.array(a)), kind="stable")
    steps = np.abs(np.diff(sums[order], axis=0))
    assert steps.max(initial=0) <= 1


def test_equal_crossings_lead_over_edges_and_corners() -> None:
    assert marked((0.5, 0.5, 0.5), (2.5, 2.5, 2.5)) == {(0, 0, 0), (1, 1, 1), (2, 2, 2)}
    assert marked((2.5, 0.5, 0.25), (0.5, 2.5, 0.25)) == {(2, 0, 0), (1, 1, 0), (0, 2, 0)}


def test_a_way_within_a_face_is_in_the_upper_voxels() -> None:
    assert marked((0.5, 2.0, 0.5), (2.5, 2.0, 0.5)) == {(0, 2, 0), (1, 2, 0), (2, 2, 0)}
    assert marked((2.5, 2.0, 1.0), (0.5, 2.0, 1.0)) == {(0, 2, 1), (1, 2, 1), (2, 2, 1)}
    assert marked((0.5, 4.0, 0.5), (2.5, 4.0, 0.5)) == set()  # there is no upper one


def test_what_a_way_only_touches_from_outside_is_not_marked() -> None:
    assert marked((-1.0, 1.0, 0.5), (1.0, -1.0, 0.5)) == set()
    assert marked((6.0, 1.5, 0.5), (5.0, 1.5, 0.5)) == set()


def test_numbers_next_to_faces_and_of_no_size_do_no_harm() -> None:
    below, tiny = float(np.nextafter(2.0, 0.0)), 5e-324
    assert marked((below, 1.0, 1.0), (2.0, 1.0, 1.0)) == {(1, 1, 1), (2, 1, 1)}
    assert marked((0.0, 0.0, 0.0), (tiny, -tiny, 0.0)) == {(0, 0, 0)}
    assert marked((2.0, 2.0, 2.0), (2.0, 2.0, 2.0)) == {(2, 2, 2)}
    assert marked((-1e15, 0.5, 0.5), (1e15, 0.5, 0.5)) == {(i, 0, 0) for i in range(5)}
