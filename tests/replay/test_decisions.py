"""Decisions of steered sessions, made again: `verify`, `accept` and the plugin of pytest."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from chsel.policies import build_policy
from replay.__main__ import main
from replay.comparing.verification import DIFFERS, EQUAL, Verdict, verify
from replay.events import Decided, Event, Probe, ProblemPosed
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover
from replay.mcap.viewer_messages import next_probe
from replay.mcap.writer import McapRecorder
from replay.verbs.info import recording_info
from tests.replay.conftest import same_bits
from tests.replay.mcap.test_recovery import chunks_of
from tests.tools.small_recordings import steered_session, write_recording

pytest_plugins = ["pytester"]


@pytest.fixture
def path(steered, write):
    return write(steered)


def decided(events: list[Event], step: int) -> Decided:
    return next(e for e in events if isinstance(e, Decided) and e.step == step)


def with_decision(events: list[Event], step: int, **changes: Any) -> list[Event]:
    """The events with other values in a decision."""
    old = decided(events, step)
    new = dataclasses.replace(old, decision=dataclasses.replace(old.decision, **changes))
    return [new if event is old else event for event in events]


def differing(path: Path) -> list[Verdict]:
    return [found for found in verify(read_recording(path)) if found.outcome == DIFFERS]


@pytest.mark.parametrize("policy", ["information", "voxel_entropy", "random", "nearest_mean"])
def test_decisions_are_equal_where_they_were_made(policy, write):
    path = write(steered_session(policy=policy))
    found = list(verify(read_recording(path)))
    assert [verdict.outcome for verdict in found] == [EQUAL] * 7
    assert [v.step for v in found if v.is_decision] == [-1, 0, 1, 2]
    assert {verdict.name for verdict in found if verdict.is_decision} == {policy}


def test_a_surprise_starts_the_next_registration_afresh_in_replays_too(write):
    events = steered_session(surprise={"limit": 0.0, "larger": 2})
    posed = [event.problem for event in events if isinstance(event, ProblemPosed)]
    assert [len(problem.initial_set) for problem in posed] == [8, 8, 8]
    assert not differing(write(events))


def test_the_first_candidate_with_another_score_is_named(steered, write, capsys):
    score = decided(steered, 1).decision.score.copy()
    last = int(np.flatnonzero(np.isfinite(score))[-1])
    score[last] += 0.25
    path = write(with_decision(steered, 1, score=score))
    (found,) = differing(path)
    assert (found.step, found.before, found.stage) == (1, 4, "score")
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "decision after step 1, information: differs" in shown
    assert re.search(
        rf"score: 1 of 8 numbers by up to \d+ ulp \(0.25\), the first at {last}", shown
    )


def slightly(value: Any) -> Any:
    """Another value: the next number up, another text, or a wrong index."""
    if isinstance(value, str):
        return "gain"
    return value - 1 if isinstance(value, int) else np.nextafter(value, 9.0)


@pytest.mark.parametrize(
    "name",
    [
        *("spread", "score", "hit_chance", "blocked_chance", "expected_spread"),
        *("chosen", "contacts", "surprise"),
    ],
)
def test_what_differs_is_named(steered, write, name):
    made = decided(steered, 0)
    if name == "surprise":
        other = dataclasses.replace(made, surprise=slightly(made.surprise))
        events = [other if event is made else event for event in steered]
    else:
        value = slightly(getattr(made.decision, name))
        if name == "chosen":  # one that could be taken
            value = int(np.argsort(made.decision.score)[-2])
        events = with_decision(steered, 0, **{name: value})
    found = next(verdict for verdict in differing(write(events)) if verdict.is_decision)
    assert (found.step, found.stage) == (0, name.replace("_", " "))
    assert found.differences[0].startswith(f"{name}: ")


def test_another_belief_and_surprise_are_named(steered, write):
    old = decided(steered, 1)
    weights = np.array([0.5, 0.5, *np.zeros(len(old.problem.belief) - 2)])
    belief = dataclasses.replace(old.problem.belief, weights=weights)
    problem = dataclasses.replace(old.problem, belief=belief)
    other = dataclasses.replace(old, problem=problem, surprise=old.surprise + 1.0)
    changed = [other if event is old else event for event in steered]
    found = differing(write(changed))[0]
    assert found.stage == "belief"
    assert any(line.startswith("belief.weights: ") for line in found.differences)
    assert any(line.startswith("surprise: ") for line in found.differences)


def rate_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have `information` rate every action half as high again."""
    policy = type(build_policy("information"))
    rate = policy.rate
    monkeypatch.setattr(policy, "rate", lambda _, *given: 1.5 * rate(*given))


def test_a_policy_that_rates_otherwise_differs_in_its_scores(path, monkeypatch):
    rate_more(monkeypatch)
    assert {verdict.stage for verdict in differing(path)} == {"score"}


def test_a_policy_that_is_not_installed_is_named(steered, write, capsys):
    start: Any = steered[0]
    config = start.config | {"policy": {"name": "tea_leaves"}}
    path = write([dataclasses.replace(start, config=config), *steered[1:]])
    assert main(["verify", str(path)]) == 2
    shown = capsys.readouterr().err
    assert "tea_leaves" in shown
    assert "accepted: " in shown
    assert shown.count("\n") == 1


def test_accepted_decisions_are_those_that_verify_then_expects(path, monkeypatch, capsys):
    before = path.read_bytes()
    assert main(["accept", str(path), "--yes"]) == 0
    assert "nothing to change" in capsys.readouterr().out
    assert path.read_bytes() == before
    rate_more(monkeypatch)
    assert main(["accept", str(path), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert "4 of 7 results are new" in shown
    assert not differing(path)


def test_each_decision_is_an_item_of_pytest(pytester, steered, write, tmp_path):
    folder = tmp_path / "kept"
    folder.mkdir()
    score = decided(steered, 1).decision.score * 2.0
    shutil.move(write(with_decision(steered, 1, score=score)), folder / "box.mcap")
    result = pytester.runpytest_inprocess("--replays", str(folder), "-v")
    result.assert_outcomes(passed=6, failed=1)
    result.stdout.fnmatch_lines(["*box.mcap::decision after step 1, information FAILED*"])
    result.stdout.fnmatch_lines(["*score: * of 8 numbers by up to *"])


def test_a_recovered_recording_is_verified_as_far_as_it_goes(steered, tmp_path):
    lost = decided(steered, 0)
    path = tmp_path / "lost.mcap"
    write_recording(path, [event for event in steered if event is not lost])
    found = list(verify(read_recording(path)))
    assert {verdict.outcome for verdict in found} == {EQUAL}
    assert len(found) == 6


@pytest.fixture
def decisions(steered_events):
    return [event for event in steered_events if isinstance(event, Decided)]


def flushed(path: Path, events: list[Event]) -> bytes:
    """A recording with a chunk for each decision, and one for each probe with its results."""
    recorder = McapRecorder(path)
    for event in events:
        if isinstance(event, Probe | Decided):
            recorder.flush()
        recorder.record(event)
    recorder.close()
    return path.read_bytes()


def test_info_names_the_policy_and_how_it_stopped(steered_events, events, write, capsys):
    path = write(steered_events)
    last = read_recording(path).decision(2).decision
    expected = {"name": "dice", "stop": "spread", "spread": last.spread}
    assert recording_info(path)["policy"] == expected
    assert main(["info", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    spread = f"{1000.0 * last.spread:.1f} mm"
    assert f"policy dice, decisions 4, stopped by spread, spread of the poses {spread}" in shown
    cut = [e for e in steered_events if not isinstance(e, Decided) or e.step < 2]
    unknown = {"name": "dice", "stop": None, "spread": None}
    assert recording_info(write(cut))["policy"] == unknown
    assert recording_info(write(events))["policy"] is None


def test_decisions_are_exported_in_three_forms(steered_events, decisions, write, tmp_path):
    path = str(write(steered_events))
    outs = {name: tmp_path / f"out.{name}" for name in ("csv", "json", "npz")}
    for out in outs.values():
        assert main(["export", path, "--what", "decisions", "-o", str(out)]) == 0
    rows = list(csv.DictReader(outs["csv"].open(newline="")))
    listed = json.loads(outs["json"].read_text())
    arrays = np.load(outs["npz"])
    assert arrays["steps"].tolist() == [-1, 0, 1, 2]
    for row, same, event in zip(rows, listed, decisions, strict=True):
        made, chosen = event.decision, event.decision.chosen
        assert (int(row["step"]), row["policy"], row["stop"]) == (event.step, "dice", made.stop)
        assert (float(row["spread"]), float(row["surprise"])) == (made.spread, event.surprise)
        assert int(row["chosen"]) == same["chosen"] == chosen
        if chosen >= 0:
            assert float(row["expected_spread"]) == made.expected_spread[chosen]
            pose = event.problem.actions.world_from_hand[chosen]
            assert [float(row[name]) for name in ("dx", "dy", "dz")] == pose[:3, 2].tolist()
        else:
            assert row["x"] == row["score"] == ""
            assert same["x"] is None
        for name in ("score", "contacts", "hit_chance"):
            assert same_bits(arrays[f"step_{event.step}/{name}"], getattr(made, name))
        assert same_bits(arrays[f"step_{event.step}/poses"], event.problem.belief.object_from_world)


def recovered(path: Path, data: bytes) -> tuple[list[Event], dict[str, str]]:
    """Events that a damaged file gives, and what is lost."""
    out = path.with_name("recovered.mcap")
    path.write_bytes(data)
    found = recover(path, out)
    return list(read_recording(out).events()), found.lost


def test_a_decision_behind_a_lost_probe_is_not_believed(steered_events, tmp_path):
    path = tmp_path / "damaged.mcap"
    data = bytearray(flushed(path, steered_events))
    start, end = chunks_of(bytes(data), "/probe")[1]
    data[start + 40 : end - 40] = bytes(end - start - 80)
    events, lost = recovered(path, bytes(data))
    assert [event.step for event in events if isinstance(event, Decided)] == [-1, 0]
    assert {"/decision of step 1", "/decision of step 2"} <= set(lost)


def test_viewers_get_an_arrow_from_start_to_end(decisions):
    first, last = decisions[0], decisions[-1]
    (entity,) = SceneUpdate.FromString(next_probe(first, 5)).entities
    (arrow,) = entity.arrows
    pose = first.problem.actions.world_from_hand[first.decision.chosen]
    position: Any = arrow.pose.position
    assert np.allclose([position.x, position.y, position.z], pose[:3, 3])
    q = arrow.pose.orientation
    along = [
        1.0 - 2.0 * (q.y**2 + q.z**2),
        2.0 * (q.x * q.y + q.w * q.z),
        2.0 * (q.x * q.z - q.w * q.y),
    ]
    assert np.allclose(along, pose[:3, 2])
    length = first.problem.actions.length[first.decision.chosen]
    assert np.isclose(arrow.shaft_length + arrow.head_length, length)
    (entity,) = SceneUpdate.FromString(next_probe(last, 5)).entities
    assert len(entity.arrows) == 0
