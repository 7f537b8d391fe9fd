"""Measured values that do not follow from the results are named by `verify`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from replay.__main__ import main
from replay.comparing.differences import is_close
from replay.comparing.verification import DIFFERS, EQUAL, verify
from replay.events import Event, Measured
from replay.files import file_digest
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import registered_session, write_recording


def changed(step: int, change: Callable[[str, float], float]) -> list[Event]:
    """A session with other measured values of a step."""
    return [
        Measured(step, {name: change(name, value) for name, value in event.values.items()})
        if isinstance(event, Measured) and event.step == step
        else event
        for event in registered_session("gradient_descent")
    ]


def test_wrong_numbers_are_named_by_verify(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_numbers_may_differ_as_libraries_round_and_no_more(tmp_path: Path) -> None:
    for factor, outcome in ((1 + 1e-13, EQUAL), (1 + 1e-7, DIFFERS)):
        path = tmp_path / f"{outcome}.mcap"
        write_recording(path, changed(0, lambda _, x, by=factor: x * by))  # type: ignore[misc]
        assert next(verify(read_recording(path))).outcome == outcome


def test_the_digest_of_a_recording_is_that_of_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, registered_session("gradient_descent"))
    digest = file_digest(path)
    assert read_recording(path).digest == digest
    assert main(["verify", str(path)]) == 0
    assert capsys.readouterr().out.endswith(f" s, digest {digest}\n")
    assert main(["info", str(path)]) == 0
    assert f"digest       {digest}" in capsys.readouterr().out


def test_pose_errors_may_differ_by_a_tenth_of_a_millimetre_and_nothing_else_may() -> None:
    assert is_close(0.01, 0.01 + 0.9e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1.1e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1e-6, "archive_coverage")
    assert not is_close(0.01, None, "best_position_error")
