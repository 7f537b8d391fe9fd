"""The pictures of what method=anchored makes of faults of sensors."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chsel.methods.anchored.anchored_settings import AnchoredSettings, Effort
from runners.reporting import fault_pictures
from runners.reporting.fault_pictures import KINDS, faulty_case, picture_of
from runners.reporting.figures import write_picture
from runners.sessions.faults import LEVELS
from tests.runners.drawn_figures import outlines_of

SETTINGS = AnchoredSettings(
    effort=Effort(
        samples=5_000,
        kept=40,
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
WHERE = ("mustard", 6, 2)  # configuration, probe and seed


def test_pictures_are_of_levels_that_differ_in_kind() -> None:
    assert set(KINDS) < set(LEVELS)
    clean = vars(LEVELS["clean"])
    ours = [{key for key, of in vars(LEVELS[kind]).items() if of != clean[key]} for kind in KINDS]
    assert all(one != other for n, one in enumerate(ours) for other in ours[:n])


def test_a_picture_marks_contacts_off_the_object_and_free_voxels_in_it(tmp_path: Path) -> None:
    case = faulty_case("mixed", *WHERE, SETTINGS)
    drawn = picture_of(case, "mixed")
    picture = Image.open(io.BytesIO(write_picture(drawn, tmp_path, "png", small=True)))
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
    monkeypatch.setattr(fault_pictures, "AnchoredSettings", lambda: SETTINGS)
    folder = tmp_path / "new" / "folder"
    words = [str(folder), "--levels", "clean", "--probe", "1"]
    monkeypatch.setattr("sys.argv", ["fault_pictures", *words])
    assert fault_pictures.main() == 0
    assert sorted(path.name for path in folder.iterdir()) == ["clean.csv", "clean.png"]
    file = folder / "clean.png"
    assert file.read_bytes().startswith(b"\x89PNG")
    assert file.stat().st_size < 80_000
    assert capsys.readouterr().out.startswith("clean: ")


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
