"""No command waits for a FIFO, nor reads a socket, a device or a folder."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from chsel.errors import ChselError, MeshError, PointsError, SessionError
from chsel.problem.file_checks import refuse_special_file
from chsel.problem.mesh import load_mesh
from replay.__main__ import main
from replay.verbs import VERBS
from runners.sensors.depth_frame import read_depth_frame
from runners.sensors.pose_file import read_pose
from runners.sessions.points import read_points
from runners.sessions.problem_source import open_source
from tests.tools.verb_arguments import verb_arguments

DESCENT = Path(__file__).resolve().parents[1] / "replays" / "cracker_box_gradient_descent.mcap"


@pytest.fixture(autouse=True)
def _ends_a_test_that_waits() -> Iterator[None]:
    def end(*_: object) -> None:
        pytest.fail("a command waits for a file that nobody writes")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(100)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def special(folder: Path, kind: str, name: str) -> Path:
    """A file of a kind that cannot be read; the folder's name stays short for a socket's sake."""
    path = folder / name
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "socket":
        here = Path.cwd()
        os.chdir(folder)  # the name of a socket has at most 107 bytes
        try:
            socket.socket(socket.AF_UNIX).bind(name)
        finally:
            os.chdir(here)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    return path


@pytest.mark.parametrize("kind", ["FIFO", "socket", "device", "folder"])
@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_refuses_what_is_no_file_in_one_line(
    tmp_path: Path,
    verb: str,
    kind: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = special(tmp_path, kind, "a.mcap")
    monkeypatch.chdir(tmp_path)
    assert main(verb_arguments(verb, path, tmp_path / "out", other=DESCENT)) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    assert str(path) in shown.err
    assert f"a {kind}" in shown.err or (kind == "folder" and "folder" in shown.err)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("kind", ["FIFO", "socket", "device"])
def test_readers_refuse_what_is_no_file(tmp_path: Path, kind: str) -> None:
    readers = {
        "a.ply": (load_mesh, MeshError),
        "a.npz": (read_points, PointsError),
        "b.csv": (read_points, PointsError),
        "c.yaml": (read_pose, SessionError),
        "d.yaml": (read_depth_frame, SessionError),
        "e.mcap": (lambda path: open_source(path, {}, {}, tmp_path, 0), ChselError),
    }
    for name, (read, error) in readers.items():
        path = special(tmp_path, kind, name)
        with pytest.raises(error, match=rf"{name}.* is a {kind}; accepted: a file"):
            read(path)


def test_a_file_a_link_to_one_and_what_does_not_exist_pass(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "file")
    for name in ("file", "link", "nothing", "a\0b"):
        refuse_special_file(name, tmp_path / name, ChselError)


def test_a_process_that_is_given_a_fifo_ends(tmp_path: Path) -> None:
    path = special(tmp_path, "FIFO", "a.mcap")
    command = [sys.executable, "-m", "replay", "info", str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
    assert ended.returncode == 2
    assert ended.stderr == f"error: recording {path} is a FIFO; accepted: a file\n"
