"""The archive, also against a plain loop."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from chsel.errors import ChselError
from chsel.qd.archive import GridArchive, rank, sampled_cell
from chsel.qd.measures import MEASURES, VECTOR, Measure, MeasureCode

XY = Measure(("x", "y"), MeasureCode(VECTOR, 2))


@numba.njit
def sampled(objectives, uniform):
    return sampled_cell(objectives, uniform)


@pytest.fixture
def archive():
    return GridArchive(XY, np.array([0.0, -1.0]), np.array([1.0, 1.0]), bins=4, dimension=2)


def cells_of(archive, measures):
    return archive.add(measures, np.zeros(len(measures)), measures).cells


def add(archive, measures, objectives):
    archive.add(np.array(measures), np.array(objectives), np.array(measures))


def test_cells_are_row_major_with_the_last_measure_fastest(archive):
    cells = cells_of(archive, np.array([[0.1, -0.9], [0.1, 0.9], [0.9, -0.9], [0.3, 0.1]]))
    np.testing.assert_array_equal(cells, [0, 3, 12, 6])


def test_elites_are_sampled_from_occupied_cells_alone(archive):
    add(archive, [[0.1, -0.9], [0.9, 0.9], [0.3, 0.1]], [-1.0, -2.0, -3.0])
    uniform = np.linspace(0.0, 1.0, 300, endpoint=False)
    drawn = np.array([sampled(archive.cells.objectives, u) for u in uniform])
    found, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(found, [0, 6, 15])
    np.testing.assert_array_equal(counts, [100, 100, 100])


def test_an_empty_archive_has_no_elite_to_sample(archive):
    assert sampled(archive.cells.objectives, 0.5) == -1
    with pytest.raises(ChselError, match="no pose"):
        _ = archive.best_solution


def test_a_solution_that_is_not_finite_never_enters(archive):
    measures = np.array([[0.1, -0.9], [0.9, 0.9]])
    solutions = np.array([[0.1, -0.9], [0.9, np.nan]])
    assert archive.add(solutions, np.array([-1.0, -2.0]), measures).cells.tolist() == [0, -1]
    np.testing.assert_array_equal(archive.occupied, [0])


def test_snapshot_is_a_copy_with_its_statistics(archive):
    add(archive, [[0.1, -0.9], [0.9, 0.9]], [-1.0, -2.0])
    snapshot = archive.snapshot(iteration=7, refinement=1)
    add(archive, [[0.1, -0.9], [0.3, 0.1]], [-0.5, -2.0])
    np.testing.assert_array_equal(snapshot.objectives, [-1.0, -2.0])
    assert snapshot.coverage == 2 / 16
    assert snapshot.qd_score == pytest.approx((99.0 + 98.0) / 16)
    assert (snapshot.iteration, snapshot.refinement) == (7, 1)


def test_angles_across_half_a_turn_stay_neighbours():
    angle = MEASURES["plane_angle"]
    values = np.array([[np.pi - 0.02], [-np.pi + 0.02], [np.pi - 0.01], [-np.pi + 0.01]])
    mean, deviation = angle.moments(values)
    assert abs(abs(mean[0]) - np.pi) < 1e-12
    assert deviation[0] == pytest.approx(np.sqrt((0.02**2 + 0.01**2) / 2), rel=1e-3)
    archive = GridArchive(angle, mean - 0.04, mean + 0.04, bins=8, dimension=1)
    order = np.argsort([-0.02, 0.02, -0.01, 0.01])
    cells = cells_of(archive, values)[order]
    np.testing.assert_array_equal(cells, [2, 3, 5, 6])


BINS, LOWER, UPPER = 4, -1.0, 1.0


class PlainArchive:
    """The definition: dictionaries and loops."""

    def __init__(self, circular):
        self.circular = circular
        self.best: dict[int, tuple[float, tuple[float, ...]]] = {}

    def cell(self, measures):
        cell = 0
        for x in measures:
            if self.circular:
                x = x - 2.0 * math.pi * round(x / (2.0 * math.pi))
            place = math.floor((BINS * (x - LOWER) + 1e-6) / (UPPER - LOWER))
            cell = cell * BINS + min(max(place, 0), BINS - 1)
        return cell

    def add(self, batch):
        before = dict(self.best)
        results = []
        for measures, objective in batch:
            if not all(map(math.isfinite, (*measures, objective))):
                results.append((0, -math.inf))
                continue
            cell = self.cell(measures)
            if cell not in before:
                results.append((2, objective))
            else:
                gain = objective - before[cell][0]
                results.append((int(gain > 0.0), gain))
            if cell not in self.best or objective > self.best[cell][0]:
                self.best[cell] = (objective, measures)
        return results


# Borders of cells, and values beyond the range; few objectives, so that many tie.
NUMBERS = [LOWER + 0.25 * i for i in range(-2, 11)] + [-50.0, 0.1, -0.6, 50.0, math.nan, math.inf]
OBJECTIVES = [-3.0, -2.0, -1.0, -1.0 + 1e-12, 0.0, math.nan, math.inf, -math.inf]
SOLUTIONS = st.tuples(
    st.tuples(st.sampled_from(NUMBERS), st.sampled_from(NUMBERS)), st.sampled_from(OBJECTIVES)
)


@settings(deadline=None, max_examples=200)
@given(st.booleans(), st.lists(st.lists(SOLUTIONS, min_size=1, max_size=9), max_size=4))
@example(True, [[((math.pi + 0.1, 3.0 * math.pi), -1.0), ((0.1 - math.pi, -math.pi), 0.0)]])
def test_insertion_is_that_of_a_plain_loop(circular, batches):
    measure = Measure(("x", "y"), MeasureCode(VECTOR, 2), circular)
    lower, upper = np.full(2, LOWER), np.full(2, UPPER)
    archive = GridArchive(measure, lower, upper, bins=BINS, dimension=3)
    plain = PlainArchive(circular)
    for batch in batches:
        measures = np.array([solution[0] for solution in batch])
        objectives = np.array([solution[1] for solution in batch])
        serial = np.arange(len(batch))[:, None]  # tells equal solutions apart
        offers = archive.add(np.hstack([serial, measures]), objectives, measures)
        found = zip(offers.status.tolist(), offers.value.tolist(), strict=True)
        assert list(found) == plain.add(batch)
    assert archive.occupied.tolist() == sorted(plain.best)
    snapshot = archive.snapshot(0, 0)
    for i, cell in enumerate(sorted(plain.best)):
        objective, measures_there = plain.best[cell]
        assert snapshot.objectives[i] == objective
        assert tuple(snapshot.measures[i]) == measures_there
        assert tuple(snapshot.solutions[i, 1:]) == measures_there


@numba.njit
def ranked(status, value, order):
    return rank(status, value, order)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from([-np.inf, -1.0, -0.0, 0.0, 2.5])),
        min_size=1,
        max_size=70,
    )
)
def test_ranking_is_by_status_then_value_then_the_later(pairs):
    status, value = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    order = np.zeros(len(pairs), dtype=np.int64)
    improved = ranked(status, value, order)
    np.testing.assert_array_equal(order, np.lexsort((value, status))[::-1])
    assert improved == (status > 0).sum()
