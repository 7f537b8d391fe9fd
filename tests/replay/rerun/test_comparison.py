"""The view of a comparison: hypotheses at their poses, ranked by one judge."""

import numpy as np
import pytest

from chsel.cost.compiled_cost import CompiledCost
from chsel.problem.poses import compose, inverse
from chsel.problem.registration_problem import Hypotheses
from replay.comparing.comparison import common_cost
from replay.mcap.reader import read_recording
from replay.rerun.comparison_view import ranked, save_comparison
from tests.replay.conftest import example_events
from tests.replay.rerun.test_recorder import shown_poses
from tests.tools.rrd_rows import read

pytestmark = pytest.mark.filterwarnings("ignore:no node of the SDF is deeper")  # a thin box

AWKWARD = "Ωther/way, b=½ {x} \\"


@pytest.fixture
def recording(write):
    """Registrations at steps 1 to 3 of four probes."""
    return read_recording(write(example_events(steps=4)))


@pytest.fixture
def results(recording):
    """Two methods; the second has nearly the worst pose of the first alone, and lacks step 2."""
    first = {step: recording.hypotheses(step) for step in (1, 2)}
    worst = ranked(first[1], judge_of(recording, 1)).object_from_world[-1:]
    one = Hypotheses(
        object_from_world=worst @ compose(np.eye(3), np.array([0.0, 0.001, 0.0])),
        cost=np.zeros(1),  # by its own measure
        duplicate=np.zeros(1, dtype=bool),
        cell=np.full(1, -1),
        elites=np.zeros((0, 4, 4)),
    )
    return {"chsel": first, AWKWARD: {1: one}}


def judge_of(recording, step):
    return CompiledCost.of(recording.problem(step), common_cost(recording).settings)


@pytest.fixture
def saved(recording, results, tmp_path):
    path = tmp_path / "comparison.rrd"
    save_comparison(path, recording, results=results)
    return path


def test_hypotheses_stand_at_their_poses_with_the_costs_of_one_judge(saved, recording, results):
    rows = read(saved)
    judge = judge_of(recording, 1)
    for n, label in enumerate(results):
        found = results[label][1]
        distinct = found.object_from_world[~found.duplicate]
        shown = shown_poses(rows, f"/hypotheses/{n}", step=1)
        expected = dict(zip(judge.evaluate(distinct).tolist(), inverse(distinct), strict=True))
        assert sorted(shown) == sorted(expected)
        for cost, pose in expected.items():
            np.testing.assert_allclose(shown[cost], pose, atol=1e-6)


def test_ranking_sorts_all_that_belongs_to_a_hypothesis(recording):
    found = recording.hypotheses(1)
    judge = judge_of(recording, 1)
    again = ranked(found, judge)
    order = np.argsort(judge.evaluate(found.object_from_world))
    assert (np.diff(again.cost) >= 0.0).all()
    assert again.cost.tobytes() == judge.evaluate(again.object_from_world).tobytes()
    for name in ("object_from_world", "duplicate", "cell"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name)[order])
    assert order.tolist() != list(range(len(order)))
