"""`replay verify`: equal bits, the smallest difference, files that cannot be used."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from chsel.problem.registration_problem import Hypotheses
from replay.__main__ import main
from replay.comparing.choices import recorded_method
from replay.comparing.differences import is_close
from replay.comparing.verification import DIFFERS, EQUAL, NO_RESULT, Verdict, verified_files, verify
from replay.events import Event, HypothesesFound, Measured, Probe, SessionStarted, Traced
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import measured_again, registered_session, write_recording

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
DESCENT = REPLAYS / "cracker_box_gradient_descent.mcap"
CHSEL = REPLAYS / "points_mustard.mcap"


@pytest.fixture
def write_today(write):
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


@pytest.mark.parametrize("path", [DESCENT, CHSEL], ids=lambda path: path.stem)
def test_equal_bits_are_status_0(path, capsys):
    assert main(["verify", str(path)]) == 0
    shown = capsys.readouterr()
    assert re.fullmatch(
        rf"{path}: 4 of 4 steps equal \(\w+\), \d+\.\d s, digest \w{{32}}\n", shown.out
    )
    assert shown.err == ""


def test_one_cost_that_is_one_ulp_larger_is_found(write_today, capsys):
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


def test_the_sign_of_a_zero_is_a_difference(write_today):
    events = events_of(DESCENT)
    poses = result(events, 0).object_from_world.copy()
    assert poses[0, 3, 0] == 0.0
    poses[0, 3, 0] = -0.0
    found = verdicts(write_today(with_result(events, 0, object_from_world=poses)))
    assert found[0].outcome == DIFFERS
    assert found[0].largest_ulps == 1


def test_another_last_result_shows_in_how_the_next_sets_follow(write_today):
    """E_0 and E_l of the next problem were not made from this result."""
    events = events_of(DESCENT)
    poses = result(events, 0).object_from_world.copy()
    poses[0, 0, 3] += 0.01
    found = verdicts(write_today(with_result(events, 0, object_from_world=poses)))
    assert [verdict.outcome for verdict in found] == [DIFFERS, DIFFERS, EQUAL, EQUAL]
    assert found[1].stage == "making E_0"


def test_problems_of_another_recording_are_taken_as_they_are(write_today):
    events = events_of(DESCENT)
    start = events[0]
    assert isinstance(start, SessionStarted)
    poses = result(events, 0).object_from_world.copy()
    poses[0, 0, 3] += 0.01
    changed = [dataclasses.replace(start, source="0" * 32), *events[1:]]
    found = verdicts(write_today(with_result(changed, 0, object_from_world=poses)))
    assert [verdict.outcome for verdict in found] == [DIFFERS, EQUAL, EQUAL, EQUAL]


def test_a_changed_trace_names_its_iteration(write_today):
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


def test_how_far_a_result_is_trusted_is_computed_again(write):
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


def test_a_registration_that_was_interrupted_has_nothing_to_compare(write_today, capsys):
    events = events_of(DESCENT)
    last = [i for i, event in enumerate(events) if isinstance(event, HypothesesFound)][-1]
    path = write_today(events[:last])
    assert [verdict.outcome for verdict in verdicts(path)] == [EQUAL, EQUAL, EQUAL, NO_RESULT]
    assert main(["verify", str(path)]) == 0
    assert "3 of 3 steps equal (gradient_descent)" in capsys.readouterr().out


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_file_without_a_result_cannot_be_verified(write_today, capsys, jobs):
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


def test_other_settings_than_those_that_gave_the_result_are_found(write_today):
    events = events_of(DESCENT)
    start = events[0]
    assert isinstance(start, SessionStarted)
    config = {**start.config, "method": {**start.config["method"], "descent": {"restarts": 3}}}
    found = verdicts(write_today([dataclasses.replace(start, config=config), *events[1:]]))
    assert {verdict.outcome for verdict in found} == {DIFFERS}
    assert "which does not come about" in found[0].stage


def test_several_files_and_processes_give_the_same_verdicts(tmp_path, write_today, capsys):
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
def test_what_cannot_be_verified_is_one_line_and_status_2(arguments, message, capsys):
    try:
        status = main(["verify", *arguments])
    except SystemExit as exit:
        status = int(str(exit.code))
    shown = capsys.readouterr()
    assert status == 2
    assert shown.err.startswith("error: ")
    assert message in shown.err
    assert shown.err.count("\n") == 1


def changed(step: int, change: Callable[[str, float], float]) -> list[Event]:
    """A session with other measured values of a step."""
    return [
        Measured(step, {name: change(name, value) for name, value in event.values.items()})
        if isinstance(event, Measured) and event.step == step
        else event
        for event in registered_session("gradient_descent")
    ]


def test_wrong_numbers_are_named_by_verify(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    write_recording(path, changed(1, lambda n, x: x / 2 if "position_error" in n else x))
    verdicts = list(verify(read_recording(path)))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL, DIFFERS]
    assert verdicts[1].stage == "the measured values"
    lines = [line.split(":")[0] for line in verdicts[1].differences]
    assert lines == ["values.best_position_error", "values.closest_position_error"]
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "step 1, gradient_descent: differs" in shown
    assert "first difference: the measured values" in shown
    without = [e for e in changed(1, lambda _, x: x) if not isinstance(e, Measured) or e.step < 1]
    write_recording(tmp_path / "b.mcap", without)
    found = list(verify(read_recording(tmp_path / "b.mcap")))
    assert [verdict.stage for verdict in found] == [
        "",
        "the measured values, which are not recorded",
    ]


def test_numbers_may_differ_as_libraries_round_and_no_more(tmp_path):
    for factor, outcome in ((1 + 1e-13, EQUAL), (1 + 1e-7, DIFFERS)):
        path = tmp_path / f"{outcome}.mcap"
        write_recording(path, changed(0, lambda _, x, by=factor: x * by))
        assert next(verify(read_recording(path))).outcome == outcome


def test_pose_errors_may_differ_by_a_tenth_of_a_millimetre_and_nothing_else_may():
    assert is_close(0.01, 0.01 + 0.9e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1.1e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1e-6, "archive_coverage")
    assert not is_close(0.01, None, "best_position_error")


REPOSITORY = Path(__file__).resolve().parents[2]
RECORDING = REPOSITORY / "tests" / "replays" / "spam_can_gradient_descent.mcap"
KERNEL = "chsel/cost/cost_kernels.py"
LINE = "value = scale * excess"
PLANTED = "value = 1.0000000000001 * scale * excess"


def verified(folder: Path, **changes: str) -> subprocess.CompletedProcess[str]:
    """`replay verify` with the packages in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "replay", "verify", str(RECORDING)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(folder), **changes},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_a_change_in_a_kernel_is_compiled_and_found(tmp_path):
    for package in ("chsel", "replay"):
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=unwanted)
    same = verified(tmp_path)
    assert same.returncode == 0, same.stderr
    assert "4 of 4 steps equal" in same.stdout
    text = (tmp_path / KERNEL).read_text()
    assert text.count(LINE) == 1
    (tmp_path / KERNEL).write_text(text.replace(LINE, PLANTED))
    done = verified(tmp_path, CHSEL_CACHE_DIR=str(tmp_path / "kept"))
    assert "compiling the kernels" in done.stderr
    assert done.returncode == 1
    stages = re.findall(r"first difference: (.*) \(", done.stdout)
    steps = re.findall(r"step -?\d+, \w+: differs", done.stdout)
    assert len(steps) == len(stages) > 0
    assert set(stages) == {"descent, iteration 0"}, done.stdout
