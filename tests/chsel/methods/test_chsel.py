"""Algorithm 1: its passes, and what a search starts from."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.methods import chsel
from chsel.methods.chsel import Chsel, ChselSettings
from chsel.methods.gradient_descent import DescentSettings
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, inverse
from chsel.problem.registration_problem import NullObserver
from chsel.problem.search_space import SE3Space
from chsel.qd.emitters import EmitterSettings
from chsel.qd.selection import OutputSettings
from tests.chsel.methods.scene import TRUTH, Watcher, around_truth, known_points, posed
from tests.chsel.samples import hypotheses_at

POINTS = known_points(TRUTH, 12)
QUICK = ChselSettings(
    descent=DescentSettings(restarts=2, iterations=15), emitter=EmitterSettings(iterations=4)
)


def algorithm(**changes):
    """Algorithm 1 on the problem of the L."""
    method = Chsel(replace(QUICK, **changes))
    return chsel._Algorithm1(posed(method, POINTS), method.settings, observer=NullObserver())


def test_every_pass_searches_again_around_the_best_of_the_last(monkeypatch):
    given, fill = [], chsel.fill_archive

    def watched(*arguments, **named):
        given.append(named["refinement"])
        fill(*arguments, **named)

    monkeypatch.setattr(chsel, "fill_archive", watched)
    method = Chsel(replace(QUICK, passes=3))
    watcher = Watcher(snapshot_interval=4)
    found = method.register(posed(method, POINTS), watcher)
    assert [archive.refinement for archive in watcher.archives] == [0, 0, 1, 1, 2, 2]
    assert given == [0, 1, 2]
    assert found.archive is not None
    assert found.archive.refinement == 2


@pytest.mark.parametrize("count", [3, 5, 4000])
def test_a_further_pass_starts_with_the_best_fifth_and_normal_draws_around_it(count):
    poses = around_truth(count)
    order = np.random.default_rng(1).permutation(count)
    estimates = replace(hypotheses_at(poses), cost=order.astype(float))
    drawn = SE3Space().encode(algorithm().resampled_around_best(estimates, 1))
    best = SE3Space().encode(Poses.of(poses[np.argsort(order)][: max(1, count // 5)]))
    np.testing.assert_allclose(drawn[: len(best)], best, atol=1e-12)
    assert len(drawn) == count
    if len(best) == 1:
        np.testing.assert_allclose(drawn, np.tile(best, (count, 1)), atol=1e-12)
    else:
        shifts = drawn[len(best) :, 6:]
        wanted = best[:, 6:]
        np.testing.assert_allclose(shifts.mean(axis=0), wanted.mean(axis=0), atol=0.002)
        np.testing.assert_allclose(shifts.std(axis=0), wanted.std(axis=0, ddof=1), rtol=0.06)


@pytest.mark.parametrize("start", ["best", "initial"])
def test_the_search_starts_from_the_best_cell_or_the_first_pose_of_e_0(monkeypatch, start):
    given = []
    monkeypatch.setattr(
        chsel, "fill_archive", lambda *values, **named: given.append((*values, named))
    )
    method = Chsel(replace(QUICK, emitter=EmitterSettings(iterations=4, start=start)))
    problem = posed(method, POINTS, initial_set=around_truth(7))
    method.register(problem)
    _, objective, named = given[0]
    vector, count = named["start"], named["count"]
    last = named["archive"].snapshot(0, 0)
    expected = last.solutions[np.argmax(last.objectives)]
    if start == "initial":
        expected = objective.space.encode(Poses.of(problem.initial_set))[0]
    np.testing.assert_array_equal(vector, expected)
    assert count == 7


def test_estimates_and_elites_outside_of_the_workspace_are_left_out():
    """A contact 3 m away has its best poses there."""
    away = np.eye(4)
    away[:3, 3] = 3.0
    points = POINTS.merged(KnownPoints(known=POINTS.known + 3.0))
    initial = np.concatenate([around_truth(4), inverse(away @ inverse(around_truth(4)))])
    for margin, leaves in ((0.15, 0), (None, 1)):
        method = Chsel(replace(QUICK, output=OutputSettings(margin=margin), starts=None))
        found = method.register(posed(method, points, initial_set=initial))
        outside = inverse(found.elites)[:, :3, 3].max(axis=1) > 1.0
        assert (outside.sum() > 0) == leaves
