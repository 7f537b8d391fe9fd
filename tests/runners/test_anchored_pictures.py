"""Pictures of method=anchored: the stages of its search, and what it makes of faults of sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chsel.methods.anchored.anchored import Anchored
from chsel.problem.poses import inverse
from replay.mcap.reader import read_recording
from runners.reporting import anchored_stages, fault_pictures
from runners.reporting.anchored_stages import picture_of_stages, stages_of
from runners.reporting.fault_pictures import KINDS, faulty_case, picture_of
from runners.reporting.figures import write_picture
from runners.sessions.faults import LEVELS
from tests.runners.drawn_figures import SMALL_SEARCH, check_outlines, outlines_of
from tests.runners.made_up_evaluations import REPLAYS

WHERE = ("mustard", 6, 2)  # configuration, probe and seed


def test_stages_are_those_of_the_registration_and_come_closer() -> None:
    recording = read_recording(REPLAYS / "mustard_chsel.mcap")
    step = recording.steps[0]
    problem = recording.problem(step)
    sampled, fitted, spread, chosen = stages_of(problem, SMALL_SEARCH)
    found = Anchored(SMALL_SEARCH).register(problem)
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
    picture = picture_of_stages(recording, step, SMALL_SEARCH, view="xz", name="stages")
    file, _ = write_picture(picture, tmp_path, "png", small=True)
    assert file.stat().st_size < 200_000
    assert Image.open(file).width == 1440
    chosen = stages_of(recording.problem(step), SMALL_SEARCH)[-1]
    axes = picture.figure.axes[-1]
    start, poses = recording.start, inverse(chosen.poses)
    check_outlines(axes, start.mesh, poses, "#0072b2", start.world_from_object)
    (contacts,) = (line for line in axes.lines if line.get_marker() == "o")
    known = [probe.contacts for probe in recording.probes if probe.step <= step]
    np.testing.assert_array_equal(contacts.get_xydata(), np.concatenate(known)[:, [0, 2]])


def test_a_step_that_is_not_there_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(REPLAYS / "mustard_chsel.mcap")
    monkeypatch.setattr("sys.argv", ["anchored_stages", path, "out.png", "--step", "999"])
    assert anchored_stages.main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "no registration problem of step 999; accepted: " in told


def test_pictures_are_of_levels_that_differ_in_kind() -> None:
    assert set(KINDS) < set(LEVELS)
    clean = vars(LEVELS["clean"])
    ours = [{key for key, of in vars(LEVELS[kind]).items() if of != clean[key]} for kind in KINDS]
    assert all(one != other for n, one in enumerate(ours) for other in ours[:n])


def test_a_picture_marks_contacts_off_the_object_and_free_voxels_in_it(tmp_path: Path) -> None:
    case = faulty_case("mixed", *WHERE, SMALL_SEARCH)
    drawn = picture_of(case, "mixed")
    picture = Image.open(write_picture(drawn, tmp_path, "png", small=True)[0])
    assert (picture.format, picture.mode, picture.width) == ("PNG", "P", 1440)
    assert case.off.shape == (2, len(case.contacts))
    far = np.abs(case.off[0]) > 0.01
    assert 0 < far.sum() < len(far)
    assert len(case.wrong) > 0
    side, front, distances = drawn.figure.axes
    for axes, chosen in ((side, [0, 2]), (front, [1, 2])):
        points = {line.get_marker(): line.get_xydata() for line in axes.lines}
        np.testing.assert_array_equal(points["o"], case.contacts[~far][:, chosen])
        np.testing.assert_array_equal(points["X"], case.contacts[far][:, chosen])
        np.testing.assert_array_equal(points["s"], case.wrong[:, chosen])
        assert [style for _, _, style in outlines_of(axes)].count("dashed") == 1
    rings, dots = (np.asarray(line.get_xdata()) for line in distances.lines[-2:])
    np.testing.assert_allclose(1e-3 * rings, case.off[0])
    np.testing.assert_allclose(1e-3 * dots, case.off[1])


def test_the_command_writes_a_small_file_for_each_level(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fault_pictures, "AnchoredSettings", lambda: SMALL_SEARCH)
    folder = tmp_path / "new" / "folder"
    words = [str(folder), "--levels", "clean", "--probe", "1"]
    monkeypatch.setattr("sys.argv", ["fault_pictures", *words])
    assert fault_pictures.main() == 0
    assert sorted(path.name for path in folder.iterdir()) == ["clean.csv", "clean.png"]
    file = folder / "clean.png"
    assert file.read_bytes().startswith(b"\x89PNG")
    assert file.stat().st_size < 80_000
    told, *written = capsys.readouterr().out.splitlines()
    assert told.startswith("clean: ")
    assert written == [f"written: {file}", f"written: {file.with_suffix('.csv')}"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--levels", "none"], "level is 'none'; accepted: clean, noise_1mm"),
        (["--configuration", "none"], "configuration 'none' does not exist; accepted: drill"),
        (["--probe", "-1"], "probe is -1; accepted: 0 to 15"),
        (["--seed", "-1"], "seed"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.setattr("sys.argv", ["fault_pictures", str(tmp_path), *words])
    assert fault_pictures.main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert message in told
    assert list(tmp_path.iterdir()) == []
