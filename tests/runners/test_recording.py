from __future__ import annotations

from pathlib import Path

import pytest

from chsel.errors import RecordingError
from runners.recording import make_run_folder


def test_run_folders_of_one_second_differ_and_stay_in_the_log_folder(tmp_path: Path) -> None:
    folders = {make_run_folder(tmp_path, "ycb/drill", "chsel") for _ in range(5)}
    assert len(folders) == 5
    assert all(
        folder.parent == tmp_path and "_ycb-drill_chsel_" in folder.name for folder in folders
    )


@pytest.mark.parametrize("name", ["../../x", "a\0b", "x" * 5000, "a b\n"])
def test_names_from_a_file_can_not_lead_elsewhere(tmp_path: Path, name: str) -> None:
    folder = make_run_folder(tmp_path, name, "chsel")
    assert folder.is_dir()
    assert folder.parent == tmp_path


def test_a_folder_that_can_not_be_made_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"cannot be made .*; accepted: a writable logs=DIR"):
        make_run_folder(tmp_path / "file", "drill")
