"""The picture of the stages of method=anchored."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from chsel.methods.anchored import Anchored, AnchoredSettings, Effort
from replay.mcap.reader import read_recording
from runners.reporting.anchored_stages import main, picture_of_stages, stages_of
from tests.runners.made_up_evaluations import REPLAYS

SETTINGS = AnchoredSettings(effort=Effort(5_000, 40, 6, 20, 6, 8, 20, 8, 40, 4, 40))


def test_stages_are_those_of_the_registration_and_come_closer() -> None:
    recording = read_recording(REPLAYS / "mustard_chsel.mcap")
    step = recording.steps[0]
    problem = recording.problem(step)
    sampled, fitted, spread, chosen = stages_of(problem, SETTINGS)
    found = Anchored(SETTINGS).register(problem)
    np.testing.assert_array_equal(chosen.energies, np.sort(found.cost))
    assert len(sampled.poses) == 40
    assert len(fitted.poses) > 40  # those of E_0 too
    medians = [np.median(stage.energies) for stage in (sampled, fitted, spread)]
    assert medians[0] > medians[1] > medians[2]
    apart = np.abs(chosen.energies[:, None] - spread.energies).min(axis=1)
    assert apart.max() < 1e-9  # metres; rotations are orthonormal again


def test_the_picture_is_a_small_file() -> None:
    recording = read_recording(REPLAYS / "mustard_chsel.mcap")
    picture = picture_of_stages(recording, recording.steps[0], SETTINGS, "xz")
    assert len(picture) < 200_000
    assert Image.open(io.BytesIO(picture)).width == 1440


def test_a_step_that_is_not_there_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(REPLAYS / "mustard_chsel.mcap")
    monkeypatch.setattr("sys.argv", ["anchored_stages", path, "out.png", "--step", "999"])
    assert main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "no registration problem of step 999; accepted: " in told
