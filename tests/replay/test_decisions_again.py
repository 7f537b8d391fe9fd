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
    assert {verdict.name for verdict in found if verdict.is_decision} == {policy}


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
def test_what_differs_is_named(steered: list[Event], write: Write, name: str) -> None:
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


def test_another_belief_and_surprise_are_named(steered: list[Event], write: Write) -> None:
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


def test_a_policy_that_rates_otherwise_differs_in_its_scores(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate_more(monkeypatch)
    assert {verdict.stage for verdict in differing(path)} == {"score"}


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
    assert "4 of 7 results are new" in shown
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
    result.stdout.fnmatch_lines(["*score: * of 8 numbers by up to *"])


def test_a_recovered_recording_is_verified_as_far_as_it_goes(
    steered: list[Event], tmp_path: Path
) -> None:
    lost = decided(steered, 0)
    path = tmp_path / "lost.mcap"
    write_recording(path, [event for event in steered if event is not lost])
    found = list(verify(read_recording(path)))
    assert {verdict.outcome for verdict in found} == {EQUAL}
    assert len(found) == 6
