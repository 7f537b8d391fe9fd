"""Decisions of a steered session in the Rerun recording, read back with Rerun's own reader."""

import dataclasses

import numpy as np
import pytest
import trimesh

from chsel.events import ActionsOffered, Decided, Probe, SessionEnded
from chsel.next_probe.decision_problem import (
    Actions,
    Decision,
    DecisionProblem,
    HandShape,
    WeightedPoses,
)
from chsel.problem.points import KnownPoints
from chsel.problem.poses import compose
from chsel.problem.streams import StreamKey
from tests.replay.rerun.test_recorder import ALONG_X, SDF, WORKSPACE, started, write
from tests.tools.rrd_rows import read, shown_at

ACTIONS = Actions(
    compose(
        np.stack([np.eye(3), np.eye(3), ALONG_X]),
        np.array([[0.0, 0.0, -0.6], [0.1, 0.0, -0.6], [0.0, 0.2, 0.7]]),
    ),
    np.array([0.5, 0.02, 0.4]),
)
HAND = HandShape.of(trimesh.creation.box(extents=(0.02, 0.04, 0.1)))


def decided(step, chosen, *, score, stop=""):
    problem = DecisionProblem(
        sdf=SDF,
        points=KnownPoints(),
        workspace=WORKSPACE,
        free_resolution=0.01,
        belief=WeightedPoses(np.eye(4)[None], np.ones(1)),
        actions=ACTIONS,
        available=np.isfinite(score),
        hand=HAND,
        key=StreamKey(0, step + 1),
    )
    contacts = [[0.0, 0.0, -0.15], [np.nan] * 3] if chosen >= 0 else np.zeros((0, 3))
    decision = Decision(
        chosen=chosen,
        stop=stop,
        spread=0.1 / (step + 2),
        score=np.array(score),
        hit_chance=np.array([0.75, 0.5, 0.25]),
        blocked_chance=np.zeros(3),
        expected_spread=np.array([0.03, 0.04, 0.05]) / (step + 2),
        contacts=np.array(contacts),
    )
    return Decided(step, problem, decision=decision, surprise=0.5 * (step + 1))


def probe(step, *, hit):
    path = compose(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, -0.6], [0.0, 0.0, -0.3]]))
    contacts = np.array([[0.0, 0.0, -0.15]]) if hit else np.zeros((0, 3))
    points = KnownPoints(free=np.full((1, 3), 0.1 * step), known=contacts)
    return Probe(
        step, "contact" if hit else "free", new_points=points, gripper_path=path, contacts=contacts
    )


def session():
    yield dataclasses.replace(started(None), initial_points=KnownPoints())
    yield ActionsOffered(-1, ACTIONS, hand=HAND)
    yield decided(-1, 0, score=[3.0, 1.0, 2.0])
    yield probe(0, hit=True)
    yield decided(0, 2, score=[-np.inf, -np.inf, 7.0])
    yield probe(1, hit=False)
    yield decided(1, -1, score=[-np.inf] * 3, stop="actions")
    yield SessionEnded(1, "finished")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    return read(write(tmp_path_factory.mktemp("rerun") / "a.rrd", session()))


@pytest.mark.parametrize(("step", "chosen"), [(-1, 0), (0, 2), (1, None)])
def test_the_next_probe_and_its_forecast_stand_at_the_step_before_it(rows, step, chosen):
    way = shown_at(rows["/scene/actions/chosen"], step)
    forecast = shown_at(rows["/scene/actions/forecast"], step)["Points3D:positions"]
    if chosen is None:
        assert way["Arrows3D:origins"] == forecast == []
        return
    pose, length = ACTIONS.world_from_hand[chosen], ACTIONS.length[chosen]
    np.testing.assert_allclose(way["Arrows3D:origins"], pose[None, :3, 3], rtol=1e-6)
    np.testing.assert_allclose(way["Arrows3D:vectors"], length * pose[None, :3, 2], rtol=1e-6)
    np.testing.assert_allclose(forecast, [[0.0, 0.0, -0.15]], rtol=1e-6)


def test_actions_that_are_offered_later_take_the_place_of_the_first(tmp_path):
    fewer = Actions(ACTIONS.world_from_hand[[2, 1]], ACTIONS.length[[2, 1]])
    before = [*session()][:-2]
    later = [ActionsOffered(1, fewer, hand=HAND), SessionEnded(1, "finished")]
    rows = read(write(tmp_path / "b.rrd", [*before, *later]))["/scene/actions/offered"]
    for step, actions in ((-1, ACTIONS), (0, ACTIONS), (1, fewer)):
        starts = shown_at(rows, step)["Arrows3D:origins"]
        np.testing.assert_allclose(starts, actions.world_from_hand[:, :3, 3], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("spread/spread", {-1: 100.0, 0: 50.0, 1: 100.0 / 3.0}),
        ("spread/expected", {0: 30.0, 1: 25.0}),  # of the chosen action, at its own probe
        ("hit/forecast_chance", {0: 0.75, 1: 0.25}),
        ("hit/outcome", {0: 1.0, 1: 0.0}),
        ("surprise/surprise", {0: 0.5, 1: 1.0}),
    ],
)
def test_what_happened_stands_beside_its_forecast(rows, name, expected):
    curve = {
        times["probe"]: values["Scalars:scalars"][0]
        for times, values in rows[f"/decision/{name}"]
        if "Scalars:scalars" in values
    }
    assert curve == pytest.approx(expected)
