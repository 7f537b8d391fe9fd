"""The compiled archive against a plain loop over its definition."""

from __future__ import annotations

import math

import numba
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from chsel.qd.archive import GridArchive, rank
from chsel.qd.measures import VECTOR, Measure, MeasureCode

BINS, LOWER, UPPER = 4, -1.0, 1.0
Solution = tuple[tuple[float, ...], float]


class PlainArchive:
    """The definition: dictionaries and loops."""

    def __init__(self, circular: bool) -> None:
        self.circular = circular
        self.best: dict[int, tuple[float, tuple[float, ...]]] = {}

    def cell(self, measures: tuple[float, ...]) -> int:
        cell = 0
        for x in measures:
            if self.circular:
                x = x - 2.0 * math.pi * round(x / (2.0 * math.pi))
            place = math.floor((BINS * (x - LOWER) + 1e-6) / (UPPER - LOWER))
            cell = cell * BINS + min(max(place, 0), BINS - 1)
        return cell

    def add(self, batch: list[Solution]) -> list[tuple[int, float]]:
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
def test_insertion_is_that_of_a_plain_loop(circular: bool, batches: list[list[Solution]]) -> None:
    measure = Measure(("x", "y"), MeasureCode(VECTOR, 2), circular)
    lower, upper = np.full(2, LOWER), np.full(2, UPPER)
    archive = GridArchive(measure, lower, upper, bins=BINS, dimension=3)
    plain = PlainArchive(circular)
    for batch in batches:
        measures = np.array([solution[0] for solution in batch])
        objectives = np.array([solution[1] for solution in batch])
        serial = np.arange(len(batch))[:, None]  # tells equal solutions apart
        status, value = archive.add(np.hstack([serial, measures]), objectives, measures)
        assert list(zip(status.tolist(), value.tolist(), strict=True)) == plain.add(batch)
    assert archive.occupied.tolist() == sorted(plain.best)
    snapshot = archive.snapshot(0, 0)
    for i, cell in enumerate(sorted(plain.best)):
        objective, measures_there = plain.best[cell]
        assert snapshot.objectives[i] == objective
        assert tuple(snapshot.measures[i]) == measures_there
        assert tuple(snapshot.solutions[i, 1:]) == measures_there


@numba.njit
def ranked(status, value, order):  # type: ignore[no-untyped-def]
    return rank(status, value, order)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from([-np.inf, -1.0, -0.0, 0.0, 2.5])),
        min_size=1,
        max_size=70,
    )
)
def test_ranking_is_by_status_then_value_then_the_later(pairs: list[tuple[int, float]]) -> None:
    status, value = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    order = np.zeros(len(pairs), dtype=np.int64)
    improved = ranked(status, value, order)
    np.testing.assert_array_equal(order, np.lexsort((value, status))[::-1])
    assert improved == (status > 0).sum()
