"""Elites that are selected, the extent of an archive, and the order of hypotheses."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from chsel import KnownPoints, RegistrationProblem, Workspace
from chsel.problem.poses import Poses, compose, inverse
from chsel.problem.search_space import SE3Space, search_space
from chsel.problem.streams import StreamKey
from chsel.qd.archive import Evaluated
from chsel.qd.measures import MEASURES
from chsel.qd.selection import (
    ArchiveSettings,
    OutputSettings,
    ranked,
    ranked_hypotheses,
    repeated,
    select_elites,
    sized_archive,
)
from tests.chsel.samples import ball_grid

COSTS = np.array([3.0, 0.1, 9.0, 0.2, 0.4, 0.6])


def problem_of(count, sdf=None):
    """One of so many hypotheses and 10 known points, in a workspace of a metre."""
    return RegistrationProblem(
        sdf=ball_grid(0.05, 0.02, half=5) if sdf is None else sdf,
        points=KnownPoints(known=np.full((10, 3), 0.5)),
        initial_set=np.tile(np.eye(4), (count, 1, 1)),
        workspace=Workspace((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        free_resolution=0.05,
        key=StreamKey(0, 0),
    )


LOWEST = OutputSettings(
    choice="lowest", ratio=5.0, tolerance_per_point=2e-3, free_tolerance=0.2, margin=None
)


def at(x):
    """Transforms (B, 4, 4) of an object at (x, 0.5, 0.5), x (B,)."""
    position = np.stack([x, np.full(len(x), 0.5), np.full(len(x), 0.5)], axis=1)
    return inverse(compose(np.tile(np.eye(3), (len(x), 1, 1)), position))


def selected(costs, x, *, count, sdf=None, **changes):
    """Which elites with such costs (C,), at x (C,), are chosen."""
    settings = replace(LOWEST, **changes)
    problem = problem_of(count, sdf)
    stream = np.random.default_rng(0)
    space = search_space(None, problem.sdf)
    return select_elites(
        costs, Poses.of(at(x)), problem=problem, space=space, settings=settings, stream=stream
    ).tolist()


def chosen(count, **changes):
    return selected(COSTS, np.full(len(COSTS), 0.5), count=count, **changes)


def test_the_lowest_costs_are_chosen_in_their_order():
    assert chosen(3, limit="none") == [1, 3, 4]


def test_paper_returns_fewer_when_the_archive_holds_fewer():
    assert chosen(9, limit="none", shortage="fewer") == [1, 3, 4, 5, 0, 2]


def test_next_best_cells_come_before_copies():
    assert chosen(5, limit="ratio") == [1, 3, 4, 5, 0]
    assert chosen(8, limit="ratio") == [1, 1, 3, 3, 4, 5, 0, 2]


def test_reference_resamples_within_five_times_the_best():
    drawn = chosen(200, limit="ratio", shortage="resample")
    assert set(drawn) == {1, 3, 4}
    assert COSTS[drawn].tolist() == sorted(COSTS[drawn])
    assert min(drawn.count(i) for i in (1, 3, 4)) > 40
    assert chosen(2, limit="ratio", shortage="resample") == [1, 3]


def test_noise_limit_is_lowest_plus_tolerance_where_that_is_larger():
    changes = {"limit": "noise", "shortage": "fewer", "free_tolerance": 0.5}
    assert chosen(9, tolerance_per_point=0.001, **changes) == [1, 3, 4, 5]
    assert chosen(9, tolerance_per_point=0.5, **changes) == [1, 3, 4, 5, 0]


def archive_of(values, costs, *, settings):
    """The archive that estimates of such measures (B, 2) and costs (B,) size."""
    measure = MEASURES["position_2"]
    estimates = Evaluated(np.zeros((len(costs), 9)), costs, measures=values)
    return sized_archive(estimates, measure, settings=settings, known_count=5, dimension=9)


@pytest.mark.parametrize(("outliers", "kept"), [("none", 5), ("ratio", 3), ("quantile", 4)])
def test_outliers_do_not_widen_the_archive(outliers, kept):
    costs = np.array([0.1, 0.2, 0.3, 0.9, 50.0])
    values = np.array([[0.0, 0.0], [0.2, 0.1], [0.4, -0.1], [1.0, 1.0], [30.0, 30.0]])
    settings = ArchiveSettings(outliers=outliers, tolerance_per_point=0.0, bins=10)
    archive = archive_of(values, costs, settings=settings)
    mean, deviation = values[:kept].mean(axis=0), values[:kept].std(axis=0)
    np.testing.assert_allclose(archive.lower, mean - 3 * deviation)
    np.testing.assert_allclose(archive.upper, mean + 3 * deviation)
    assert archive.shape == (10, 10)


def test_equal_estimates_still_make_an_archive_of_some_width():
    values = np.tile([0.3, 0.2], (6, 1))
    archive = archive_of(values, np.ones(6), settings=ArchiveSettings())
    np.testing.assert_allclose(archive.upper - archive.lower, 2 * 3 * 0.005)


def test_repetitions_are_flagged_after_the_first():
    poses = np.stack([np.eye(4), 2 * np.eye(4), np.eye(4), 2 * np.eye(4), 3 * np.eye(4)])
    assert repeated(Poses.of(poses)).tolist() == [False, False, True, True, False]
    assert repeated(Poses.of(poses[:0])).tolist() == []


def test_hypotheses_come_in_the_order_of_their_costs():
    poses = at(np.array([0.3, 0.1, 0.3, 0.2]))
    order = [1, 3, 0, 2]
    along_x: Any = SimpleNamespace(space=SE3Space(), costs=lambda vectors: -vectors[:, 6])
    found = ranked_hypotheses(along_x, Poses.of(poses))
    np.testing.assert_allclose(found.object_from_world, poses[order])
    np.testing.assert_allclose(found.cost, [0.1, 0.2, 0.3, 0.3])
    assert found.duplicate.tolist() == [False, False, False, True]
    assert found.cell.tolist() == [-1] * 4
    assert ranked(poses, -poses[:, 0, 3], cells=np.arange(4)).cell.tolist() == order


GROUPS = np.array([0.1, 0.101, 0.102, 0.103, 0.5, 0.501, 0.502, 0.503, 0.9, 0.901, 0.902, 0.903])
RISING = np.linspace(0.0, 0.011, len(GROUPS))  # costs: the first group has the lowest
NEAR: dict[str, Any] = {"tolerance_per_point": 0.002, "free_tolerance": 0.0}  # a limit of 0.02


def test_representatives_are_of_all_groups_below_the_limit():
    lowest = selected(RISING, GROUPS, count=3, **NEAR)
    assert lowest == [0, 1, 2]
    representative = selected(RISING, GROUPS, count=3, choice="representative", **NEAR)
    assert [i // 4 for i in representative] == [0, 1, 2]
    costs = np.where(GROUPS < 0.8, RISING, 1.0)
    below = selected(costs, GROUPS, count=3, choice="representative", **NEAR)
    assert sorted({i // 4 for i in below}) == [0, 1]


def test_as_many_representatives_as_wanted_however_many_there_are():
    x = np.linspace(0.0, 1.0, 3000)
    costs = np.linspace(0.0, 0.01, 3000)
    for count in (1, 30, 700):
        found = selected(costs, x, count=count, choice="representative", **NEAR)
        assert len(set(found)) == count
        assert found == sorted(found)
        gaps = np.diff(np.concatenate([[0.0], np.sort(x[found]), [1.0]]))
        assert gaps.max() < 2.5 / count + 0.01


def test_of_poses_that_are_alike_as_many_are_chosen():
    costs = np.linspace(0.0, 0.01, 40)
    alike = selected(costs, np.full(40, 0.3), count=5, choice="representative", **NEAR)
    assert len(set(alike)) == 5
    assert alike[0] == 0


def test_lowest_are_chosen_where_too_few_are_below_the_limit():
    costs = np.where(GROUPS < 0.2, RISING, 1.0 + RISING)
    assert selected(costs, GROUPS, count=6, choice="representative", **NEAR) == [0, 1, 2, 3, 4, 5]


def test_lowest_are_chosen_of_an_object_without_a_surface():
    thin = ball_grid(-0.01, 0.02, half=5)
    assert selected(RISING, GROUPS, count=3, sdf=thin, choice="representative", **NEAR) == [0, 1, 2]


def test_poses_beside_the_workspace_are_not_chosen_unless_all_are():
    x = np.array([1.3, 0.2, -0.3, 1.1, 0.9, 7.0])
    assert selected(COSTS, x, count=3) == [1, 3, 4]
    assert selected(COSTS, x, count=3, margin=0.15) == [1, 3, 4]
    assert selected(COSTS, x, count=3, margin=0.05) == [1, 1, 4]
    assert selected(COSTS, x + 10.0, count=3, margin=0.15) == [1, 3, 4]
