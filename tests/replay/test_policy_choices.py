"""`step --policy` and `compare --policies`: what would the others have done?"""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from chsel.errors import RecordingError, SettingError
from chsel.next_probe.decision_problem import Actions
from chsel.policies import build_policy
from chsel.problem.poses import axis_angle, compose
from replay.__main__ import main
from replay.comparing.policy_choices import (
    PolicyChoice,
    choice_table,
    decision_problem,
    policy_choices,
    policy_contenders,
)
from replay.console import Console
from replay.events import Decided, Event
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import STEERED, registered_session, steered_session

Write = Callable[[list[Event]], Path]
OTHERS = ("voxel_entropy", "nearest_mean", "grid")


@pytest.fixture(scope="module")
def steered() -> list[Event]:
    return steered_session()


@pytest.fixture
def path(steered: list[Event], write: Write) -> Path:
    return write(steered)


def test_others_decide_on_the_recorded_problem(path: Path) -> None:
    recording = read_recording(path)
    changes = [f"{key}={value}" for key, value in (("stop.spread", 0.0), ("stop.gain", 0.0))]
    policies = policy_contenders(recording, OTHERS, changes)
    for step in (-1, 1):
        recorded, *choices = policy_choices(recording, policies, [step])
        problem = recording.decision(step).problem
        assert recorded.label == "recorded: information"
        for name, choice in zip(OTHERS, choices, strict=True):
            expected = build_policy(name, {"stop": STEERED["stop"]}).decide(problem)
            assert choice.decision is not None
            assert choice.decision.digest == expected.digest
            assert recorded.decision is not None
            assert choice.as_recorded is (expected.chosen == recorded.decision.chosen)


def test_the_recorded_policy_has_its_recorded_settings(path: Path) -> None:
    recording = read_recording(path)
    same, other = policy_contenders(
        recording, ["information", "information#2"], ["information#2:noise=0.5"]
    )
    recorded, again, wide = policy_choices(recording, [same, other], [0])
    assert again.as_recorded
    assert again.decision is not None
    assert recorded.decision is not None
    assert again.decision.digest == recorded.decision.digest
    assert wide.decision is not None
    assert wide.decision.digest != recorded.decision.digest
    assert other.changes == ("noise=0.5",)


def test_a_step_without_a_decision_has_the_belief_of_its_registration(
    steered: list[Event], path: Path, write: Write
) -> None:
    """As that of a session that was interrupted."""
    (last,) = (event for event in steered if isinstance(event, Decided) and event.step == 2)
    cut = read_recording(write([event for event in steered if event is not last]))
    made, recorded = decision_problem(cut, 2), last.problem
    assert cut.decision_steps == (-1, 0, 1)
    assert made.digest == recorded.digest
    assert np.count_nonzero(~made.available) == 3


def test_step_shows_a_row_for_each_policy(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--policy", "information", "policy.noise=0.5", "--policy", "information"]
    assert main(["step", str(path), "--step", "1", *words]) == 0
    shown = capsys.readouterr().out
    title = "after step 1 by information: 4 poses, 6 of 8 actions available"
    assert title in " ".join(shown.split())
    rows = [line.split() for line in shown.splitlines() if re.match(r" *1 ", line)]
    assert [row[1] for row in rows] == ["recorded", "information", "information#2"]
    assert rows[0][2:] == rows[2][2:] != rows[1][2:]
    assert "information with policy.noise=0.5" in shown


def test_every_number_is_whole_on_a_narrow_terminal(path: Path) -> None:
    recording = read_recording(path)
    assert recording.offered is not None
    actions, choices = recording.offered.actions, []
    turn = axis_angle(np.array([0.0, 1.0, 0.0]), 2.5)
    turned = Actions(compose(turn, [-0.4, -0.3, -0.5]) @ actions.world_from_hand, actions.length)
    for label in ("hypothesis_pruning", "expected_loss"):
        made = recording.decision(0).decision
        scores = np.full(len(turned), -1.234e-5)
        changed = dataclasses.replace(
            made, score=scores, expected_spread=np.full(len(turned), 0.0654)
        )
        choices.append(PolicyChoice(12, label, changed))
    text = io.StringIO()
    Console(file=text, width=80).print(choice_table(turned, choices, "each step"))
    rows = [line for line in text.getvalue().splitlines() if line.startswith("12 ")]
    pose = turned.world_from_hand[changed.chosen]
    start = " ".join(f"{1000.0 * value:.0f}" for value in pose[:3, 3])
    hits = f"{made.hit_chance[made.chosen]:.2f}"
    for row, choice in zip(rows, choices, strict=True):
        expected = f"12 {choice.label} {made.chosen} {start} -1.23e-05 {hits} 65.4"
        assert row.split() == expected.split()
    direction = " ".join(f"{value:.2f}" for value in pose[:3, 2])
    assert text.getvalue().count(direction) == len(choices)


def test_compare_counts_agreement_and_writes_a_table(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "choices.csv"
    words = ["--policies", "information", "grid", "--save-csv", str(out)]
    assert main(["compare", str(path), *words]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^information +4 +4 of 4 +1 ", shown, re.M)
    rows = list(csv.DictReader(out.open(newline="")))
    assert len(rows) == 3 * 4
    recording = read_recording(path)
    assert recording.offered is not None
    for row in rows[::3]:
        decision = recording.decision(int(row["step"])).decision
        assert (int(row["chosen"]), row["stop"]) == (decision.chosen, decision.stop)
        if decision.chosen >= 0:
            pose = recording.offered.actions.world_from_hand[decision.chosen]
            assert [float(row[name]) for name in ("x_m", "y_m", "z_m")] == pose[:3, 3].tolist()
            expected = float(decision.expected_spread[decision.chosen])
            assert float(row["expected_spread_m"]) == expected


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["step", "--step", "1", "--policy", "dice"], "policy is 'dice'; accepted: grid, "),
        (["step", "--step", "1", "--policy", "noise=1"], "--policy noise=1 names none; accepted:"),
        (["step", "--step", "1", "--policy", "grid", "random"], "--policy names grid and random"),
        (["step", "--step", "7", "--policy", "grid"], "no registration problem of step 7"),
        (["step", "--step", "1", "--policy", "grid", "--method", "icp"], "registers and writes"),
        (["compare", "--policies", "grid", "grid"], "'grid' is named twice"),
        (["compare", "--policies", "grid", "nois=1"], "nois does not exist in grid; did you mean"),
        (["compare", "--policies", "grid", "dice:noise=1"], "names no policy here; accepted: grid"),
        (["compare", "--policies", "grid", "noise=-1"], "noise"),
        (["compare", "--policies", "grid", "--save-plot", "a.png"], "--policies writes tables"),
        (["compare", "--policies", "grid", "--steps", "9"], "there is no step 9"),
    ],
)
def test_what_cannot_be_is_one_line(
    path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([words[0], str(path), *words[1:]]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1


@pytest.mark.parametrize(
    "words", [["step", "--step", "1", "--policy", "grid"], ["compare", "--policies", "grid"]]
)
def test_a_session_that_was_not_steered_has_no_actions(
    write: Write, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(registered_session("gradient_descent"))
    assert main([words[0], str(path), *words[1:]]) == 2
    message = "has no actions to choose from; accepted: a recording of a steered session\n"
    assert capsys.readouterr().err.endswith(message)


def test_labels_and_steps_of_no_policy_are_refused(path: Path) -> None:
    recording = read_recording(path)
    with pytest.raises(SettingError, match="no policy is named; accepted: grid"):
        policy_contenders(recording, [])
    with pytest.raises(RecordingError, match="no registration problem of step -3"):
        decision_problem(recording, -3)
