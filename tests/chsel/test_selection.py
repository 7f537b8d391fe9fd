from __future__ import annotations

import numpy as np
import pytest

from chsel.measures import MEASURES
from chsel.selection import ArchiveSettings, OutputSettings, repeated, select_elites, sized_archive

COSTS = np.array([3.0, 0.1, 9.0, 0.2, 0.4, 0.6])


def chosen(count: int, **changes: object) -> list[int]:
    settings = OutputSettings(**changes)  # type: ignore[arg-type]
    stream = np.random.default_rng(0)
    return select_elites(COSTS, count, settings, 10, stream).tolist()


def test_the_lowest_costs_are_chosen_in_their_order() -> None:
    assert chosen(3, limit="none") == [1, 3, 4]


def test_paper_returns_fewer_when_the_archive_holds_fewer() -> None:
    assert chosen(9, limit="none", shortage="fewer") == [1, 3, 4, 5, 0, 2]


def test_next_best_cells_come_before_copies() -> None:
    assert chosen(5, limit="ratio") == [1, 3, 4, 5, 0]
    assert chosen(8, limit="ratio") == [1, 1, 3, 3, 4, 5, 0, 2]


def test_reference_resamples_within_five_times_the_best() -> None:
    drawn = chosen(200, limit="ratio", shortage="resample")
    assert set(drawn) == {1, 3, 4}
    assert COSTS[drawn].tolist() == sorted(COSTS[drawn])
    assert min(drawn.count(i) for i in (1, 3, 4)) > 40
    assert chosen(2, limit="ratio", shortage="resample") == [1, 3]


def test_noise_limit_is_lowest_plus_tolerance_where_that_is_larger() -> None:
    changes = {"limit": "noise", "shortage": "fewer", "free_tolerance": 0.5}
    assert chosen(9, tolerance_per_point=0.001, **changes) == [1, 3, 4, 5]
    assert chosen(9, tolerance_per_point=0.5, **changes) == [1, 3, 4, 5, 0]


@pytest.mark.parametrize(("outliers", "kept"), [("none", 5), ("ratio", 3), ("quantile", 4)])
def test_outliers_do_not_widen_the_archive(outliers: str, kept: int) -> None:
    costs = np.array([0.1, 0.2, 0.3, 0.9, 50.0])
    values = np.array([[0.0, 0.0], [0.2, 0.1], [0.4, -0.1], [1.0, 1.0], [30.0, 30.0]])
    settings = ArchiveSettings(outliers=outliers, tolerance_per_point=0.0, bins=10)
    archive = sized_archive(MEASURES["position_2"], values, costs, settings, 5, 9)
    mean, deviation = values[:kept].mean(axis=0), values[:kept].std(axis=0)
    np.testing.assert_allclose(archive.lower, mean - 3 * deviation)
    np.testing.assert_allclose(archive.upper, mean + 3 * deviation)
    assert archive.shape == (10, 10)


def test_equal_estimates_still_make_an_archive_of_some_width() -> None:
    values = np.tile([0.3, 0.2], (6, 1))
    archive = sized_archive(MEASURES["position_2"], values, np.ones(6), ArchiveSettings(), 5, 9)
    np.testing.assert_allclose(archive.upper - archive.lower, 2 * 3 * 0.005)


def test_repetitions_are_flagged_after_the_first() -> None:
    poses = np.stack([np.eye(4), 2 * np.eye(4), np.eye(4), 2 * np.eye(4), 3 * np.eye(4)])
    assert repeated(poses).tolist() == [False, False, True, True, False]
    assert repeated(poses[:0]).tolist() == []
