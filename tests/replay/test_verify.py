"""`replay verify`: equal bits, the smallest difference, files that cannot be used."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from chsel.problem.registration_problem import Hypotheses
from replay.__main__ import main
from replay.comparing.choices import recorded_method
from replay.comparing.verification import DIFFERS, EQUAL, NO_RESULT, Verdict, verified_files, verify
from replay.events import Event, HypothesesFound, Measured, Probe, SessionStarted, Traced
from replay.mcap.reader import read_recording
from tests.tools import small_recordings
from tests.tools.small_recordings import measured_again

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
DESCENT = REPLAYS / "cracker_box_gradient_descent.mcap"
CHSEL = REPLAYS / "points_mustard.mcap"

Write = Callable[[list[Event]], Path]


@pytest.fixture
def write_today(write: Write) -> Write:
    """Records events of older recordings as well, whose measured values had another definition."""
    return lambda events: write(measured_again(events))


def events_of(path: Path) -> list[Event]:
    return list(read_recording(path).events())


def with_result(events: list[Event], index: int, **changes: np.ndarray) -> list[Event]:
    """The events with another result of the index-th registration."""
    at = [i for i, event in enumerate(events) if isinstance(event, HypothesesFound)][index]
    event = events[at]
    assert isinstance(event, HypothesesFound)
    changed = dataclasses.replace(event.hypotheses, **changes)
    return [*events[:at], HypothesesFound(event.step, changed), *events[at + 1 :]]


def result(events: list[Event], index: int) -> Hypotheses:
    return [e.hypotheses for e in events if isinstance(e, HypothesesFound)][index]


def verdicts(path: Path) -> list[Verdict]:
    return list(verify(read_recording(path)))


def test_a_recording_written_again_holds_the_same(write: Write) -> None:
    assert main(["diff", str(CHSEL), str(write(events_of(CHSEL)))]) == 0


@pytest.mark.parametrize("path", [DESCENT, CHSEL], ids=lambda path: path.stem)
def test_equal_bits_are_status_0(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(path)]) == 0
    shown = capsys.readouterr()
    assert re.fullmatch(
        rf"{path}: 4 of 4 steps equal \(\w+\), \d+\.\d s, digest \w{{32}}\n", shown.out
    )
    assert shown.err == ""


def test_one_cost_that_is_one_ulp_larger_is_found(
    write_today: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    events = events_of(DESCENT)
    cost = result(events, 1).cost.copy()
    cost[3] = np.nextafter(cost[3], 0.0)
    path = write_today(with_result(events, 1, cost=cost))
    found = verdicts(path)
    assert [verdict.outcome for verdict in found] == [EQUAL, DIFFERS, EQUAL, EQUAL]
    assert found[1].stage == "choosing the hypotheses"
    assert found[1].largest_ulps == 1
    assert found[1].differences[0].startswith("cost: 1 of 30 numbers by up to 1 ulp")
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "3 of 4 steps equal" in shown
    assert "largest difference: 1 ulp\n" in shown
    assert "environment: " in shown


def test_the_sign_of_a_zero_is_a_difference(write_today: Write) -> None:
    events = events_of(DESCENT)
    poses = result(events, 0).object_from_world.copy()
    assert poses[0, 3, 0] == 0.0
    poses[0, 3, 0] = -0.0
    found = verdicts(write_today(with_result(events, 0, object_from_world=poses)))
    assert found[0].outcome == DIFFERS
    assert found[0].largest_ulps == 1


def test_another_last_result_shows_in_how_the_next_sets_follow(write_today: Write) -> None:
    """E_0 and E_l of the next problem were not made from this result."""
    events = events_of(DESCENT)
    poses = result(events, 0).object_from_world.copy()
    poses[0, 0, 3] += 0.01
    found = verdicts(write_today(with_result(events, 0, object_from_world=poses)))
    assert [verdict.outcome for verdict in found] == [DIFFERS, DIFFERS, EQUAL, EQUAL]
    assert found[1].stage == "making E_0"


def test_problems_of_another_recording_are_taken_as_they_are(write_today: Write) -> None:
    events = events_of(DESCENT)
    start = events[0]
    assert isinstance(start, SessionStarted)
    poses = result(events, 0).object_from_world.copy()
    poses[0, 0, 3] += 0.01
    changed = [dataclasses.replace(start, source="0" * 32), *events[1:]]
    found = verdicts(write_today(with_result(changed, 0, object_from_world=poses)))
    assert [verdict.outcome for verdict in found] == [DIFFERS, EQUAL, EQUAL, EQUAL]


def test_a_changed_trace_names_its_iteration(write_today: Write) -> None:
    events = events_of(CHSEL)
    at = next(
        i
        for i, event in enumerate(events)
        if isinstance(event, Traced) and (event.stage, event.iteration) == ("cma_mega", 20)
    )
    events[at] = dataclasses.replace(events[at], digest="0" * 32)
    found = verdicts(write_today(events))
    assert [verdict.outcome for verdict in found] == [DIFFERS, EQUAL, EQUAL, EQUAL]
    assert found[0].stage == "cma_mega, iteration 20"
    assert "12 recorded stages before it are equal" not in found[0].report()


def test_how_far_a_result_is_trusted_is_computed_again(write: Write) -> None:
    method = recorded_method(read_recording(DESCENT)).build()
    events = measured_again(events_of(DESCENT), method)
    places = [i for i, event in enumerate(events) if isinstance(event, Measured)]
    changes: list[dict[str, float]] = [{}, {"verdict": 3.5}, {"modes": 9.0}, {}]
    for change, place in zip(changes, places, strict=True):
        event = events[place]
        assert isinstance(event, Measured)
        events[place] = Measured(event.step, {**event.values, **change})
    found = verdicts(write(events))
    assert [verdict.outcome for verdict in found] == [EQUAL, DIFFERS, DIFFERS, EQUAL]
    assert {verdict.stage for verdict in found[1:3]} == {"the measured values"}
    assert found[1].differences[0].startswith("values.verdict: 3.5 -> ")
    assert found[2].differences[0].startswith("values.modes: 9.0 -> ")


def test_a_recording_without_symmetries_has_no_errors_to_compare(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(small_recordings, "symmetry_for_errors", lambda _: None)
    events = small_recordings.registered_session("gradient_descent")
    assert isinstance(events[0], SessionStarted)
    assert events[0].world_from_object is not None
    assert [verdict.outcome for verdict in verdicts(write(events))] == [EQUAL, EQUAL]


def test_a_registration_that_was_interrupted_has_nothing_to_compare(
    write_today: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    events = events_of(DESCENT)
    last = [i for i, event in enumerate(events) if isinstance(event, HypothesesFound)][-1]
    path = write_today(events[:last])
    assert [verdict.outcome for verdict in verdicts(path)] == [EQUAL, EQUAL, EQUAL, NO_RESULT]
    assert main(["verify", str(path)]) == 0
    assert "3 of 3 steps equal (gradient_descent)" in capsys.readouterr().out


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_file_without_a_result_cannot_be_verified(
    write_today: Write, capsys: pytest.CaptureFixture[str], jobs: str
) -> None:
    events = events_of(DESCENT)
    first = next(i for i, e in enumerate(events) if isinstance(e, HypothesesFound))
    posed = write_today(events[:first])
    assert main(["verify", str(posed), "--jobs", jobs]) == 2
    shown = capsys.readouterr()
    message = "has no registration with a result to verify; accepted: a recording of at least one"
    assert shown.err == f"error: recording {posed} {message}\n"
    assert shown.out == ""
    probes = [e for e in events if isinstance(e, SessionStarted | Probe)]
    path = write_today(probes)
    assert main(["verify", str(path), "--jobs", jobs]) == 2
    assert message in capsys.readouterr().err


def test_other_settings_than_those_that_gave_the_result_are_found(write_today: Write) -> None:
    events = events_of(DESCENT)
    start = events[0]
    assert isinstance(start, SessionStarted)
    config = {**start.config, "method": {**start.config["method"], "descent": {"restarts": 3}}}
    found = verdicts(write_today([dataclasses.replace(start, config=config), *events[1:]]))
    assert {verdict.outcome for verdict in found} == {DIFFERS}
    assert "which does not come about" in found[0].stage


def test_several_files_and_processes_give_the_same_verdicts(
    tmp_path: Path, write_today: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "several"
    folder.mkdir()
    for path in (DESCENT, CHSEL):
        shutil.copy(path, folder)
    (folder / "broken.mcap").write_bytes(DESCENT.read_bytes()[:5000])
    paths = sorted(folder.iterdir())
    alone, together = list(verified_files(paths)), list(verified_files(paths, jobs=2))
    for file in (*alone, *together):
        file.seconds = 0.0
    assert alone == together
    assert main(["verify", str(folder)]) == 2
    shown = capsys.readouterr()
    assert "3 recordings: 8 of 8 steps equal" in shown.out
    assert shown.err.startswith(f"error: recording {folder}/broken.mcap is unfinished")
    assert shown.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "recording nowhere.mcap does not exist"),
        ([str(DESCENT), "--step", "3"], "has no registration problem of step 3; accepted: 8, 9"),
        ([str(DESCENT), "--jobs", "0"], "--jobs is 0; accepted: an integer from 1 to 256"),
        ([], "the following arguments are required: FILE"),
        ([str(Path(__file__).parent)], "has no recordings; accepted: files *.mcap in it"),
    ],
)
def test_what_cannot_be_verified_is_one_line_and_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = main(["verify", *arguments])
    except SystemExit as exit:
        status = int(str(exit.code))
    shown = capsys.readouterr()
    assert status == 2
    assert shown.err.startswith("error: ")
    assert message in shown.err
    assert shown.err.count("\n") == 1


def test_steps_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(DESCENT), "--step", "11", "--step", "9"]) == 0
    assert "2 of 2 steps equal" in capsys.readouterr().out
