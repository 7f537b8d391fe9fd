"""`step --policy` and `compare --policies`: what would the others have done?"""

from __future__ import annotations

import csv
import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from chsel.next_probe.decision_problem import Actions
from chsel.policies import build_policy
from chsel.problem.poses import axis_angle, compose
from replay.__main__ import main
from replay.comparing.choices import POLICY, chosen
from replay.events import Decided
from replay.mcap.reader import Recording, read_recording
from replay.verbs.compare import policy_decisions
from tests.tools.small_recordings import STEERED

OTHERS = ("voxel_entropy", "nearest_mean", "grid")


@pytest.fixture
def path(steered, write):
    return write(steered)


def rows_of(recording: Recording, step: int, *words: str) -> list[dict[str, Any]]:
    return list(policy_decisions(recording, chosen(recording, POLICY, words), [step]))


def test_others_decide_on_the_recorded_problem(path):
    recording = read_recording(path)
    for step in (-1, 1):
        recorded, *rows = rows_of(recording, step, *OTHERS, "stop.spread=0.0", "stop.gain=0.0")
        assert recorded["label"] == "recorded: information"
        assert recorded["chosen"] == recording.decision(step).decision.chosen
        for name, row in zip(OTHERS, rows, strict=True):
            policy = build_policy(name, {"stop": STEERED["stop"]})
            expected = policy.decide(recording.decision(step).problem)
            action = expected.chosen
            assert (row["label"], row["chosen"]) == (name, action)
            assert row["score"] == expected.score[action]
            assert row["blocked_chance"] == expected.blocked_chance[action]
            assert row["as_recorded"] is (action == recorded["chosen"])


def test_the_recorded_policy_has_its_recorded_settings(path):
    words = ("information", "information#2", "information#2:noise=0.5")
    recorded, again, wide = rows_of(read_recording(path), 0, *words)
    assert again["as_recorded"]
    numbers = ("chosen", "spread_m", "score", "hit_chance", "expected_spread_m")
    assert [again[name] for name in numbers] == [recorded[name] for name in numbers]
    assert wide["score"] != recorded["score"]
    assert wide["changes"] == "noise=0.5"


def test_start_and_direction_are_the_hands_place_and_its_z_axis(steered):
    """Seen with hands that are turned about an axis of no symmetry."""
    turn = axis_angle(np.array([0.36, 0.48, 0.8]), np.array(2.1))
    decided = next(event for event in steered if isinstance(event, Decided))
    old = decided.problem.actions
    turned = Actions(compose(turn, [0.0, 0.1, 0.2]) @ old.world_from_hand, old.length)
    problem = dataclasses.replace(decided.problem, actions=turned)
    decided = dataclasses.replace(decided, problem=problem)
    (row,) = policy_decisions(_Recorded(decided), [], [-1])
    pose = decided.problem.actions.world_from_hand[decided.decision.chosen]
    forward = pose @ [0.0, 0.0, 1.0, 0.0]
    assert [row[name] for name in ("dx", "dy", "dz")] == pytest.approx(forward[:3], abs=1e-15)
    place = pose @ [0.0, 0.0, 0.0, 1.0]
    assert [row[name] for name in ("x_m", "y_m", "z_m")] == pytest.approx(place[:3], abs=1e-15)


class _Recorded:
    """A recording of one decision."""

    def __init__(self, decided: Decided) -> None:
        self.decided = decided
        self.start = dataclasses.make_dataclass("Start", ["config"])({})

    def decision(self, _: int) -> Decided:
        return self.decided


def test_step_shows_a_row_for_each_policy(path, capsys):
    words = ["--policy", "information", "policy.noise=0.5", "--policy", "information"]
    assert main(["step", str(path), "--step", "1", *words]) == 0
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.splitlines() if re.match(r" *1 ", line)]
    assert [row[1] for row in rows] == ["information", "information", "information#2"]
    assert rows[0][2:] == rows[2][2:] != rows[1][2:]
    assert "information with policy.noise=0.5" in shown


def test_compare_counts_agreement_and_writes_a_table(path, tmp_path, capsys):
    out = tmp_path / "decisions.csv"
    words = ["--policies", "information", "grid", "--save-csv", str(out)]
    assert main(["compare", str(path), *words]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^information +4 +4 of 4 +1 ", shown, re.M)
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
        (["step", "--step", "7", "--policy", "grid"], "there is no step 7"),
        (["step", "--step", "1", "--policy", "grid", "--method", "icp"], "registers nothing"),
        (["compare", "--policies", "grid", "grid"], "grid is named twice"),
        (["compare", "--policies", "grid", "nois=1"], "policy.nois does not exist; did you mean"),
        (["compare", "--policies", "grid", "dice:noise=1"], "names no policy here; accepted: grid"),
        (["compare", "--policies", "grid", "noise=-1"], "noise"),
        (["compare", "--policies", "grid", "--save-plot", "a.png"], "--policies writes tables"),
        (["compare", "--policies", "grid", "--steps", "9"], "there is no step 9"),
    ],
)
def test_what_cannot_be_is_one_line(path, words, message, capsys):
    assert main([words[0], str(path), *words[1:]]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
