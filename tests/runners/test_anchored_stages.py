"""The picture of the stages of method=anchored."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings, Effort
from chsel.problem.poses import apply, inverse
from replay.mcap.reader import read_recording
from runners.reporting.anchored_stages import main, picture_of_stages, stages_of
from runners.reporting.figures import write_picture
from tests.runners.drawn_figures import outlines_of
from tests.runners.made_up_evaluations import REPLAYS

SETTINGS = AnchoredSettings(
    effort=Effort(
        samples=5_000,
        kept=40,
        first_steps=6,
        refined=20,
        steps=6,
        descents=8,
        descent_moves=20,
        chains=8,
        moves=40,
        polished=4,
        polish_moves=40,
    )
)


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


def test_the_picture_is_a_small_file_of_poses_in_the_world(tmp_path: Path) -> None:
    recording = read_recording(REPLAYS / "mustard_chsel.mcap")
    step = recording.steps[0]
    picture = picture_of_stages(recording, step, SETTINGS, view="xz", name="stages")
    content = write_picture(picture, tmp_path, "png", small=True)
    assert len(content) < 200_000
    assert Image.open(io.BytesIO(content)).width == 1440
    chosen = stages_of(recording.problem(step), SETTINGS)[-1]
    axes = picture.figure.axes[-1]
    outlines = outlines_of(axes)
    poses = [*inverse(chosen.poses), recording.start.world_from_object]
    assert len(outlines) == len(poses) == 31
    assert [style for _, _, style in outlines] == ["solid"] * 30 + ["dashed"]
    lower, upper = np.transpose([axes.get_xlim(), axes.get_ylim()])
    mesh = np.asarray(recording.start.mesh.vertices)
    for (vertices, _, _), pose in zip(outlines, poses, strict=True):
        corners = apply(pose, mesh)[:, [0, 2]]
        in_view = np.clip([corners.min(axis=0), corners.max(axis=0)], lower, upper)
        drawn = [vertices.min(axis=0), vertices.max(axis=0)]
        np.testing.assert_allclose(drawn, in_view, atol=2.5 * (upper - lower).max() / 160.0)
    (contacts,) = (line for line in axes.lines if line.get_marker() == "o")
    known = [probe.contacts for probe in recording.probes if probe.step <= step]
    np.testing.assert_array_equal(contacts.get_xydata(), np.concatenate(known)[:, [0, 2]])


def test_a_step_that_is_not_there_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(REPLAYS / "mustard_chsel.mcap")
    monkeypatch.setattr("sys.argv", ["anchored_stages", path, "out.png", "--step", "999"])
    assert main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "no registration problem of step 999; accepted: " in told
