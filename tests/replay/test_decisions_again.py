"""Decisions of steered sessions, made again: `verify`, `accept` and the plugin of pytest."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chsel.errors import RecordingError
from chsel.policies import build_policy
from replay.__main__ import main
from replay.comparing.verification import DIFFERS, EQUAL, Verdict, verify
from replay.events import Decided, Event, ProblemPosed
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import steered_session, write_recording

pytest_plugins = ["pytester"]
Write = Callable[[list[Event]], Path]


@pytest.fixture(scope="module")
def steered() -> list[Event]:
    """Three probes; a surprise starts the last registration afresh."""
    return steered_session()


@pytest.fixture
def path(steered: list[Event], write: Write) -> Path:
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
def test_decisions_are_equal_where_they_were_made(policy: str, write: Write) -> None:
    path = write(steered_session(policy=policy))
    found = list(verify(read_recording(path)))
    assert [verdict.outcome for verdict in found] == [EQUAL] * 7
    assert [v.step for v in found if v.is_decision] == [-1, 0, 1, 2]
    assert {verdict.method for verdict in found if verdict.is_decision} == {policy}


def test_a_surprise_starts_the_next_registration_afresh_in_replays_too(write: Write) -> None:
    events = steered_session(surprise={"limit": 0.0, "larger": 2})
    posed = [event.problem for event in events if isinstance(event, ProblemPosed)]
    assert [len(problem.initial_set) for problem in posed] == [8, 8, 8]
    assert not differing(write(events))


def test_the_command_counts_decisions(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(path), "--step", "-1", "--step", "2"]) == 0
    line = r"1 of 1 steps equal \(gradient_descent\), 2 of 2 decisions equal \(information\), "
    assert re.search(line, capsys.readouterr().out)


def test_the_first_candidate_with_another_score_is_named(
    steered: list[Event], write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    score = decided(steered, 1).decision.score.copy()
    last = int(np.flatnonzero(np.isfinite(score))[-1])
    score[last] += 0.25
    path = write(with_decision(steered, 1, score=score))
    (found,) = differing(path)
    assert (found.step, found.before, found.stage) == (1, 2, f"the score of action {last}")
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "decision after step 1, information: differs" in shown
    now = f"{score[last] - 0.25:.3g}"
    assert f"score of action {last} is {now}, recorded {score[last]:.3g}" in shown


@pytest.mark.parametrize(
    ("change", "stage", "line"),
    [
        (lambda d: {"spread": np.nextafter(d.spread, 1.0)}, "the spread", r"spread: .* \(1 ulp\)"),
        (lambda d: {"hit_chance": 0.5 * d.hit_chance}, "the hit chance of action", "hit chance"),
        (
            lambda d: {"expected_spread": np.nextafter(d.expected_spread, 9.0)},
            "the expected spread of action 0",
            r"expected spread of action 0 is .*; 7 more differ",
        ),
        (
            lambda d: {"chosen": int(np.argsort(d.score)[-2])},
            "the choice",
            r"chosen: \d -> \d",
        ),
        (
            lambda d: {"chosen": -1, "stop": "gain", "contacts": d.contacts},
            "the choice",
            "stop: gain -> ''|stop: 'gain' -> ''|stop: gain -> ",
        ),
        (lambda d: {"contacts": d.contacts + 1e-9}, "the contacts", "contacts: "),
    ],
)
def test_what_differs_is_named(
    steered: list[Event], write: Write, change: Any, stage: str, line: str
) -> None:
    values = change(decided(steered, 0).decision)
    (found, *_) = differing(write(with_decision(steered, 0, **values)))
    assert found.step == 0
    assert found.stage.startswith(stage)
    assert re.search(line, "\n".join(found.differences))


def test_another_belief_and_surprise_are_named(steered: list[Event], write: Write) -> None:
    old = decided(steered, 1)
    weights = np.array([0.5, 0.5, *np.zeros(len(old.problem.belief) - 2)])
    belief = dataclasses.replace(old.problem.belief, weights=weights)
    problem = dataclasses.replace(old.problem, belief=belief)
    other = dataclasses.replace(old, problem=problem, surprise=old.surprise + 1.0)
    changed = [other if event is old else event for event in steered]
    found = differing(write(changed))[0]
    assert found.stage == "the belief"
    assert any(line.startswith("weights: ") for line in found.differences)
    assert any(line.startswith("surprise: ") for line in found.differences)


def rate_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have `information` rate every action half as high again."""
    policy = type(build_policy("information"))
    rate = policy.rate
    monkeypatch.setattr(policy, "rate", lambda _, *given: 1.5 * rate(*given))


def test_a_policy_that_rates_otherwise_differs_in_its_scores(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate_more(monkeypatch)
    assert {verdict.stage[:20] for verdict in differing(path)} == {"the score of action "}


def test_steps_alone_have_the_same_verdicts(path: Path) -> None:
    recording = read_recording(path)
    parts = [verdict for step in (-1, 0, 1, 2) for verdict in verify(recording, [step])]
    whole = list(verify(recording))
    assert [(v.label, v.outcome) for v in parts] == [(v.label, v.outcome) for v in whole]
    with pytest.raises(RecordingError, match="no registration problem of step 3"):
        list(verify(recording, [3]))


def test_a_session_that_stops_before_its_first_probe_is_verified(write: Write) -> None:
    path = write(steered_session(stop={"spread": 9.0, "gain": 0.0}))
    (found,) = verify(read_recording(path))
    assert (found.label, found.outcome) == ("decision after step -1, information", EQUAL)
    assert main(["verify", str(path)]) == 0


def test_a_policy_that_is_not_installed_is_named(
    steered: list[Event], write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    start: Any = steered[0]
    config = start.config | {"policy": {"name": "tea_leaves"}}
    path = write([dataclasses.replace(start, config=config), *steered[1:]])
    assert main(["verify", str(path)]) == 2
    shown = capsys.readouterr().err
    assert "tea_leaves" in shown
    assert "accepted: " in shown
    assert shown.count("\n") == 1


def test_accepted_decisions_are_those_that_verify_then_expects(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = path.read_bytes()
    assert main(["accept", str(path), "--yes"]) == 0
    assert "nothing to change" in capsys.readouterr().out
    assert path.read_bytes() == before
    rate_more(monkeypatch)
    assert main(["accept", str(path), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert "0 of 3 results and 4 of 4 decisions are new" in shown
    assert not differing(path)


def test_each_decision_is_an_item_of_pytest(
    pytester: pytest.Pytester, steered: list[Event], write: Write, tmp_path: Path
) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    score = decided(steered, 1).decision.score * 2.0
    shutil.move(write(with_decision(steered, 1, score=score)), folder / "box.mcap")
    result = pytester.runpytest_inprocess("--replays", str(folder), "-v")
    result.assert_outcomes(passed=6, failed=1)
    result.stdout.fnmatch_lines(["*box.mcap::decision after step 1, information FAILED*"])
    result.stdout.fnmatch_lines(["*score of action * is *, recorded *"])


def test_a_recovered_recording_is_verified_as_far_as_it_goes(
    steered: list[Event], tmp_path: Path
) -> None:
    lost = decided(steered, 0)
    path = tmp_path / "lost.mcap"
    write_recording(path, [event for event in steered if event is not lost])
    found = list(verify(read_recording(path)))
    assert {verdict.outcome for verdict in found} == {EQUAL}
    assert len(found) == 6
