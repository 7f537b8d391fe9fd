"""Decisions of steered sessions: made again, exported, and beside those of other policies."""

import csv
import dataclasses
import json
import re

import numpy as np
import pytest

from chsel.events import ActionsOffered, Decided, ProblemPosed, SessionStarted
from chsel.next_probe.decision_problem import Actions
from chsel.policies import build_policy
from chsel.problem.poses import axis_angle, compose
from replay.__main__ import main
from replay.comparing.choices import POLICY, chosen
from replay.comparing.differences import result_differences
from replay.comparing.verification import DIFFERS, EQUAL, verify
from replay.mcap.reader import read_recording
from replay.verbs.compare import policy_decisions
from tests.replay.conftest import changed, nth, same_bits
from tests.tools.small_recordings import STEERED, steered_session

_ALONG = ("dx", "dy", "dz")


@pytest.fixture
def path(steered, write):
    return write(steered)


def decided(events, step):
    return nth(events, Decided, number=step + 1)


def differing(path):
    return [found for found in verify(read_recording(path)) if found.outcome == DIFFERS]


@pytest.mark.parametrize("policy", ["information", "random"])  # with forecasts, and by chance
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
    old = decided(steered, 1)
    score = old.decision.score.copy()
    last = int(np.flatnonzero(np.isfinite(score))[-1])
    score[last] += 0.25
    path = write(changed(steered, old, decision=dataclasses.replace(old.decision, score=score)))
    (found,) = differing(path)
    assert (found.step, found.before, found.stage) == (1, 4, "score")
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "decision after step 1, information: differs" in shown
    assert re.search(
        rf"score: 1 of 8 numbers by up to \d+ ulp \(0.25\), the first at {last}", shown
    )


@pytest.mark.parametrize(
    "name",
    [
        *("spread", "score", "hit_chance", "blocked_chance", "expected_spread"),
        *("chosen", "stop", "contacts", "surprise"),
    ],
)
def test_what_differs_is_named(steered, name):
    made = decided(steered, 0)
    of = made if name == "surprise" else made.decision
    old = getattr(of, name)
    value = old + 1 if name == "chosen" else "gain" if name == "stop" else np.nextafter(old, 9.0)
    other = dataclasses.replace(of, **{name: value})
    if name != "surprise":
        other = dataclasses.replace(made, decision=other)
    found = result_differences([made], [other])
    assert found.stage == name.replace("_", " ")
    assert found.lines[0].startswith(f"{name}: ")


def test_another_belief_and_surprise_are_named(steered, write):
    old = decided(steered, 1)
    weights = np.array([0.5, 0.5, *np.zeros(len(old.problem.belief) - 2)])
    belief = dataclasses.replace(old.problem.belief, weights=weights)
    problem = dataclasses.replace(old.problem, belief=belief)
    events = changed(steered, old, problem=problem, surprise=old.surprise + 1.0)
    found = differing(write(events))[0]
    assert found.stage == "belief"
    assert any(line.startswith("belief.weights: ") for line in found.differences)
    assert any(line.startswith("surprise: ") for line in found.differences)


def test_a_policy_that_is_not_installed_is_named(steered, write, capsys):
    config = nth(steered, SessionStarted).config | {"policy": {"name": "tea_leaves"}}
    assert main(["verify", str(write(changed(steered, steered[0], config=config)))]) == 2
    shown = capsys.readouterr().err
    assert re.fullmatch(r"error: .*tea_leaves.*accepted: .*\n", shown)


def test_accepted_decisions_are_those_that_verify_then_expects(path, monkeypatch, capsys):
    policy = type(build_policy("information"))
    rate = policy.rate
    monkeypatch.setattr(policy, "rate", lambda _, *given: 1.5 * rate(*given))
    assert {verdict.stage for verdict in differing(path)} == {"score"}
    assert main(["accept", str(path), "--yes"]) == 0
    assert "4 of 7 results are new" in capsys.readouterr().out
    assert not differing(path)


def test_a_recovered_recording_is_verified_as_far_as_it_goes(steered, write):
    lost = decided(steered, 0)
    found = list(verify(read_recording(write([e for e in steered if e is not lost]))))
    assert {verdict.outcome for verdict in found} == {EQUAL}
    assert len(found) == 6


def test_decisions_are_exported_in_three_forms(steered_events, write, tmp_path):
    path = str(write(steered_events))
    outs = {name: tmp_path / f"out.{name}" for name in ("csv", "json", "npz")}
    for out in outs.values():
        assert main(["export", path, "--what", "decisions", "-o", str(out)]) == 0
    rows = list(csv.DictReader(outs["csv"].open(newline="")))
    listed = json.loads(outs["json"].read_text())
    arrays = np.load(outs["npz"])
    assert arrays["steps"].tolist() == [-1, 0, 1, 2]
    decisions = [event for event in steered_events if isinstance(event, Decided)]
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


@pytest.mark.parametrize("more", [2, 0])
def test_a_decision_on_other_actions_is_exported_with_theirs(steered_events, write, tmp_path, more):
    """As of a program that offers new actions at each step, and turned hands."""
    old = decided(steered_events, 1)
    count = len(old.problem.actions) + more
    ten = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(1.1)), np.array([0.3, 0.2, 0.1]))
    poses = np.tile(ten, (count, 1, 1))
    poses[:, 0, 3] += 0.1 * np.arange(count)
    others = Actions(poses, np.linspace(0.1, 0.2, count))
    scores = {name: np.full(count, 0.25) for name in ("score", "hit_chance", "blocked_chance")}
    decision = dataclasses.replace(
        old.decision, chosen=3, **scores, expected_spread=np.full(count, 0.01)
    )
    problem = dataclasses.replace(old.problem, actions=others, available=np.ones(count, dtype=bool))
    new = dataclasses.replace(old, problem=problem, decision=decision)
    offered = ActionsOffered(1, others, hand=nth(steered_events, ActionsOffered).hand)
    place = steered_events.index(old)
    later = [event for event in steered_events[place + 1 :] if not isinstance(event, Decided)]
    path = str(write([*steered_events[:place], offered, new, *later]))
    for name in ("csv", "npz"):
        out = str(tmp_path / f"out.{name}")
        assert main(["export", path, "--what", "decisions", "-o", out]) == 0
    rows = list(csv.DictReader((tmp_path / "out.csv").open(newline="")))
    start, along = ([float(rows[-1][name]) for name in names] for names in ("xyz", _ALONG))
    forward = ten @ [0.0, 0.0, 1.0, 0.0]
    assert (int(rows[-1]["step"]), int(rows[-1]["chosen"])) == (1, 3)
    assert start == pytest.approx([0.6, 0.2, 0.1], abs=1e-15)
    assert along == pytest.approx(forward[:3], abs=1e-15)
    arrays = np.load(tmp_path / "out.npz")
    first = nth(steered_events, ActionsOffered).actions
    assert same_bits(arrays["actions/world_from_hand"], first.world_from_hand)
    assert same_bits(arrays["step_1/world_from_hand"], others.world_from_hand)
    assert same_bits(arrays["step_1/length"], others.length)
    assert not {"step_0/world_from_hand", "step_0/length", "step_1/seconds"} & {*arrays}


def test_others_decide_on_the_recorded_problem(path):
    recording = read_recording(path)
    others = ("voxel_entropy", "nearest_mean", "grid")
    choices = chosen(recording, POLICY, words=[*others, "stop.spread=0.0", "stop.gain=0.0"])
    recorded, *rows = policy_decisions(recording, choices, steps=[1])
    assert recorded["label"] == "recorded: information"
    assert recorded["chosen"] == recording.decision(1).decision.chosen
    for name, row in zip(others, rows, strict=True):
        policy = build_policy(name, {"stop": STEERED["stop"]})
        expected = policy.decide(recording.decision(1).problem)
        action = expected.chosen
        assert (row["label"], row["chosen"]) == (name, action)
        assert row["score"] == expected.score[action]
        assert row["blocked_chance"] == expected.blocked_chance[action]
        assert row["as_recorded"] is (action == recorded["chosen"])


def test_start_and_direction_are_the_hands_place_and_its_z_axis(steered):
    """Seen with hands that are turned about an axis of no symmetry."""
    turn = axis_angle(np.array([0.36, 0.48, 0.8]), np.array(2.1))
    of_first = decided(steered, -1)
    old = of_first.problem.actions
    turned = Actions(compose(turn, [0.0, 0.1, 0.2]) @ old.world_from_hand, old.length)
    problem = dataclasses.replace(of_first.problem, actions=turned)

    class Recorded:
        start = steered[0]

        def decision(self, _):
            return dataclasses.replace(of_first, problem=problem)

    (row,) = policy_decisions(Recorded(), [], steps=[-1])
    pose = turned.world_from_hand[of_first.decision.chosen]
    forward, place = pose @ [0.0, 0.0, 1.0, 0.0], pose @ [0.0, 0.0, 0.0, 1.0]
    assert [row[name] for name in ("dx", "dy", "dz")] == pytest.approx(forward[:3], abs=1e-15)
    assert [row[name] for name in ("x_m", "y_m", "z_m")] == pytest.approx(place[:3], abs=1e-15)


def test_compare_counts_agreement_and_writes_a_table(path, tmp_path, capsys):
    out = tmp_path / "decisions.csv"
    words = ["--policies", "information", "grid", "--save-csv", str(out)]
    assert main(["compare", str(path), *words]) == 0
    assert re.search(r"^information +4 +4 of 4 +1 ", capsys.readouterr().out, re.M)
    rows = list(csv.DictReader(out.open(newline="")))
    assert len(rows) == 3 * 4
    recording = read_recording(path)
    for row in rows[::3]:
        decision = recording.decision(int(row["step"])).decision
        assert (int(row["chosen"]), row["stop"]) == (decision.chosen, decision.stop)
        if decision.chosen >= 0:
            expected = float(decision.expected_spread[decision.chosen])
            assert float(row["expected_spread_m"]) == expected


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["step", "--step", "1", "--policy", "dice"], "policy is 'dice'; accepted: grid, "),
        (["step", "--step", "1", "--policy", "noise=1"], "--policy noise=1 names none; accepted:"),
        (["step", "--step", "1", "--policy", "grid", "--method", "icp"], "registers nothing"),
        (["compare", "--policies", "grid", "nois=1"], "policy.nois does not exist; did you mean"),
        (["compare", "--policies", "grid", "--save-plot", "a.png"], "--policies writes tables"),
    ],
)
def test_what_cannot_be_is_one_line(path, words, message, capsys):
    assert main([words[0], str(path), *words[1:]]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
