"""Decisions of a steered session in the Rerun recording, read back with Rerun's own reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from chsel.next_probe.decision_problem import Actions, Belief, Decision, DecisionProblem
from chsel.next_probe.hand_shape import HandShape
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.colors import UNAVAILABLE
from replay.events import ActionsOffered, Decided, Event, Probe, SessionEnded, SessionStarted
from replay.rerun.rerun_recorder import RerunRecorder
from tests.tools.rrd_rows import Row, at_probe, read, shown_at, views_of_the_last_layout

MESH = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
SDF = SdfGrid.from_mesh(MESH, 0.05)
WORKSPACE = Workspace((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its last column
ACTIONS = Actions(
    compose(
        np.stack([np.eye(3), np.eye(3), ALONG_X]),
        np.array([[0.0, 0.0, -0.6], [0.1, 0.0, -0.6], [0.0, 0.2, 0.7]]),
    ),
    np.array([0.5, 0.02, 0.4]),
)
HAND = HandShape.of(trimesh.creation.box(extents=(0.02, 0.04, 0.1)))
ENTITIES = ("/scene/actions", "/decision")


def decided(step: int, chosen: int, score: list[float], stop: str = "") -> Decided:
    problem = DecisionProblem(
        sdf=SDF,
        points=KnownPoints(),
        workspace=WORKSPACE,
        free_resolution=0.01,
        belief=Belief(np.eye(4)[None], np.ones(1)),
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
    return Decided(step, problem, decision, surprise=0.5 * (step + 1))


def probe(step: int, *, hit: bool) -> Probe:
    path = compose(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, -0.6], [0.0, 0.0, -0.3]]))
    contacts = np.array([[0.0, 0.0, -0.15]]) if hit else np.zeros((0, 3))
    points = KnownPoints(free=np.full((1, 3), 0.1 * step), known=contacts)
    return Probe(step, "contact" if hit else "free", points, gripper_path=path, contacts=contacts)


def session() -> Iterator[Event]:
    yield SessionStarted(
        runner="probe",
        object="box",
        session="kinematic",
        method="anchored",
        seed=3,
        config={"policy": {"name": "information"}},
        mesh=MESH,
        sdf=SDF,
        workspace=WORKSPACE,
        free_resolution=0.01,
        initial_points=KnownPoints(),
    )
    yield ActionsOffered(-1, ACTIONS, HAND)
    yield decided(-1, 0, [3.0, 1.0, 2.0])
    yield probe(0, hit=True)
    yield decided(0, 2, [-np.inf, -np.inf, 7.0])
    yield probe(1, hit=False)
    yield decided(1, -1, [-np.inf] * 3, stop="actions")
    yield SessionEnded(1, "finished")


def write(path: Path, events: Iterator[Event]) -> Path:
    recorder = RerunRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("rerun") / "a.rrd", session())


@pytest.fixture(scope="module")
def rows(recording: Path) -> dict[str, list[Row]]:
    return read(recording)


def test_every_action_is_an_arrow_along_its_way_no_longer_than_it(
    rows: dict[str, list[Row]],
) -> None:
    shown = shown_at(rows["/scene/actions/offered"], -1)
    np.testing.assert_allclose(
        shown["Arrows3D:origins"], ACTIONS.world_from_hand[:, :3, 3], rtol=1e-6
    )
    vectors = np.array(shown["Arrows3D:vectors"])
    lengths = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(vectors / lengths[:, None], [[0, 0, 1], [0, 0, 1], [1, 0, 0]])
    assert lengths[1] == pytest.approx(0.02, rel=1e-6)
    assert lengths[0] == pytest.approx(lengths[2])
    assert 0.02 < lengths[0] < 0.2


@pytest.mark.parametrize(("step", "can"), [(-1, [0, 1, 2]), (0, [2]), (1, [])])
def test_better_actions_are_brighter_and_those_not_possible_grey(
    rows: dict[str, list[Row]], step: int, can: list[int]
) -> None:
    shown = shown_at(rows["/scene/actions/offered"], step)
    colors = np.array([[c >> 24, c >> 16 & 255, c >> 8 & 255] for c in shown["Arrows3D:colors"]])
    grey = (colors == UNAVAILABLE).all(axis=1)
    assert np.flatnonzero(~grey).tolist() == can
    if step == -1:
        brightness = colors @ [0.2126, 0.7152, 0.0722]
        assert np.argsort(brightness).tolist() == [1, 2, 0]


@pytest.mark.parametrize(("step", "chosen"), [(-1, 0), (0, 2), (1, None)])
def test_the_next_probe_and_its_forecast_stand_at_the_step_before_it(
    rows: dict[str, list[Row]], step: int, chosen: int | None
) -> None:
    way = shown_at(rows["/scene/actions/chosen"], step)
    forecast = shown_at(rows["/scene/actions/forecast"], step)["Points3D:positions"]
    if chosen is None:
        assert way["Arrows3D:origins"] == forecast == []
        return
    pose, length = ACTIONS.world_from_hand[chosen], ACTIONS.length[chosen]
    np.testing.assert_allclose(way["Arrows3D:origins"], pose[None, :3, 3], rtol=1e-6)
    np.testing.assert_allclose(way["Arrows3D:vectors"], length * pose[None, :3, 2], rtol=1e-6)
    np.testing.assert_allclose(forecast, [[0.0, 0.0, -0.15]], rtol=1e-6)


def test_a_moment_of_iterations_shows_the_decision_before_its_probe(
    rows: dict[str, list[Row]],
) -> None:
    decisions = [times["iteration"] for times, _ in rows["/scene/actions/chosen"]]
    probes = [times["iteration"] for times, _ in rows["/scene/gripper/path"]]
    assert decisions[0] < probes[0] < decisions[1] < probes[1] < decisions[2]


def curve(rows: dict[str, list[Row]], name: str) -> dict[int, float]:
    found = rows[f"/decision/{name}"]
    return {
        times["probe"]: values["Scalars:scalars"][0]
        for times, values in found
        if "Scalars:scalars" in values
    }


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
def test_what_happened_stands_beside_its_forecast(
    rows: dict[str, list[Row]], name: str, expected: dict[int, float]
) -> None:
    assert curve(rows, name) == pytest.approx(expected)


def test_the_hand_of_the_actions_is_drawn_where_the_probe_is_deepest(
    rows: dict[str, list[Row]],
) -> None:
    shown = shown_at(rows["/scene/hand"], 0)
    assert len(shown["Mesh3D:triangle_indices"]) == len(HAND.faces)
    np.testing.assert_allclose(shown["InstancePoses3D:translations"], [[0.0, 0.0, -0.3]], rtol=1e-6)


def test_the_log_says_what_was_decided(rows: dict[str, list[Row]]) -> None:
    lines = [values["TextLog:text"][0] for _, values in rows["/log"]]
    assert lines == [
        "next action 0 of 3: score 3, hits by 75%; spread 100 mm, 30 mm expected",
        "next action 2 of 3: score 7, hits by 25%; spread 50 mm, 25 mm expected",
        "stop, no action is left: spread 33.3 mm",
    ]


def test_the_text_about_the_session_names_the_policy(rows: dict[str, list[Row]]) -> None:
    ((_, values),) = rows["/session"]
    assert "| policy | **information** |" in values["TextDocument:text"][0]


def test_only_steered_sessions_have_views_of_decisions(tmp_path: Path, recording: Path) -> None:
    kept: Any = (e for e in session() if not isinstance(e, ActionsOffered | Decided))
    plain = write(tmp_path / "b.rrd", kept)
    assert not [name for name in read(plain) if name.startswith(ENTITIES)]
    assert not any(at_probe(found, -1) for found in read(plain).values())
    more = views_of_the_last_layout(recording) - views_of_the_last_layout(plain)
    assert more == {
        "Spread and its forecast [mm]",
        "Hit: chance and outcome",
        "Surprise [nats]",
    }
