"""Pointers of Git LFS are named by every reader of files."""

from pathlib import Path

import pytest

from chsel.errors import ChselError, PointsError, SessionError
from chsel.numerics.arrays import read_npz, refuse_special_file
from replay.files import file_digest
from replay.logs.mcap_log import RawFile
from replay.mcap.reader import read_recording
from runners.sensors.log.images import read_image
from runners.sensors.pose_file import read_yaml
from runners.sessions.points import read_points

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 12818\n"


@pytest.mark.parametrize(
    ("file_name", "read"),
    [
        ("points.ply", read_points),
        ("points.csv", read_points),
        ("points.npz", lambda path: read_npz(path, error=PointsError)),
        ("log.mcap", RawFile),
        ("recording.mcap", read_recording),
        ("recording.mcap", file_digest),
        ("depth.png", lambda path: read_image(path, "depth image")),
        ("depth.npy", lambda path: read_image(path, "depth image")),
        ("log.pose.yaml", read_yaml),
    ],
)
def test_pointers_of_git_lfs_are_named_by_every_reader(tmp_path, file_name, read):
    (tmp_path / file_name).write_text(POINTER)
    with pytest.raises(ChselError, match="is a pointer of Git LFS, not its data; run `git lfs pul"):
        read(tmp_path / file_name)


def test_other_files_and_folders_pass(tmp_path):
    (tmp_path / "notes.txt").write_text("version 1")
    for path in (tmp_path, tmp_path / "notes.txt", tmp_path / "missing"):
        refuse_special_file("it", Path(path), error=SessionError)
