"""Verbs are found by their modules."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from chsel.errors import MeshError, SessionError, SettingError
from chsel.problem.mesh import load_mesh
from replay.__main__ import main
from replay.arguments import chosen_steps
from replay.verbs import ALIASES, VERBS
from runners.sensors.depth_frame import read_depth_frame
from runners.sensors.pose_file import read_pose
from tests.tools.verb_arguments import verb_arguments


def test_former_names_are_those_of_verbs(capsys):
    assert set(ALIASES.values()) <= set(VERBS)
    assert not set(ALIASES) & set(VERBS)
    for former, verb in ALIASES.items():
        for name in (former, verb):
            with pytest.raises(SystemExit):
                main([name, "--help"])
        assert capsys.readouterr().out.count(VERBS[verb].split(",")[0]) == 2


EXISTING = (2, 3, 5, 8, 9)


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        (None, EXISTING),
        ("5", (5,)),
        ("3..8", (3, 5, 8)),
        ("4..", (5, 8, 9)),
        ("..4", (2, 3)),
        ("..", EXISTING),
        ("9, 2..3", (2, 3, 9)),
        ("3,3..3", (3,)),
        ("-7..3", (2, 3)),
    ],
)
def test_a_text_names_steps_that_exist(text, steps):
    assert chosen_steps(text, EXISTING) == steps


def test_steps_before_the_first_probe_have_numbers_too():
    assert chosen_steps("-1", (-1, 0)) == (-1,)


@pytest.mark.parametrize("text", ["", "a", "1..2..3", "1-2", "3,,5", "1.5", "99999999999"])
def test_other_texts_are_refused(text):
    with pytest.raises(SettingError, match="names no steps; accepted: steps, such as 3, "):
        chosen_steps(text, EXISTING)


@pytest.mark.parametrize("text", ["4", "6..7", "10..", "2,4", "8..3"])
def test_a_step_that_does_not_exist_is_named(text):
    with pytest.raises(SettingError, match=r"there is no step .*; accepted: 2, 3, 5, 8, 9"):
        chosen_steps(text, EXISTING)


def test_nothing_can_be_chosen_of_nothing():
    assert chosen_steps(None, ()) == ()
    with pytest.raises(SettingError, match="accepted: none"):
        chosen_steps("..", ())


DESCENT = Path(__file__).resolve().parents[1] / "replays" / "cracker_box_gradient_descent.mcap"


@pytest.fixture(autouse=True)
def _ends_a_test_that_waits():
    def end(*_: object) -> None:
        pytest.fail("a command waits for a file that nobody writes")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(100)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def special(folder: Path, kind: str, name: str) -> Path:
    """A file of a kind that cannot be read."""
    path = folder / name
    {"FIFO": os.mkfifo, "device": lambda path: path.symlink_to("/dev/zero")}[kind](path)
    return path


@pytest.mark.parametrize("kind", ["FIFO", "device"])
@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_refuses_what_is_no_file_in_one_line(tmp_path, verb, kind, capsys, monkeypatch):
    path = special(tmp_path, kind, "a.mcap")
    monkeypatch.chdir(tmp_path)
    assert main(verb_arguments(verb, path, tmp_path / "out", other=DESCENT)) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    assert str(path) in shown.err
    assert f"a {kind}" in shown.err
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("kind", ["FIFO", "device"])
def test_readers_refuse_what_is_no_file(tmp_path, kind):
    readers = {
        "a.ply": (load_mesh, MeshError),
        "c.yaml": (read_pose, SessionError),
        "d.yaml": (read_depth_frame, SessionError),
    }
    for name, (read, error) in readers.items():
        path = special(tmp_path, kind, name)
        with pytest.raises(error, match=rf"{name}.* is a FIFO, a socket or a device; acc"):
            read(path)
