"""What all verbs share: their names, steps, texts on a terminal, and files they leave alone."""

from __future__ import annotations

import io
import os
import shutil
import signal
import warnings
from pathlib import Path

import pytest
from rich.table import Table

from chsel.errors import MeshError, SessionError, SettingError
from chsel.problem.mesh import load_mesh
from replay.__main__ import main
from replay.arguments import chosen_steps
from replay.console import Console, print_error, print_warning, printable
from replay.mcap.reader import read_recording
from replay.verbs import VERBS
from runners.sensors.depth_frame import read_depth_frame
from runners.sensors.pose_file import read_pose
from tests.tools.verb_arguments import verb_arguments

REPLAY = Path(__file__).resolve().parents[1] / "replays" / "spam_can_icp.mcap"
HOSTILE = "x[/x] [red]:smile: \x1b]0;title\x07\x1b[31m\x9b\u202e.mcap"
SHOWN = "x[/x] [red]:smile: \\x1b]0;title\\x07\\x1b[31m\\x9b\\u202e.mcap"


EXISTING = (2, 3, 5, 8, 9)


def test_a_text_names_steps_that_exist():
    for text, steps in {
        "5": (5,),
        "3..8": (3, 5, 8),
        "4..": (5, 8, 9),
        "..4": (2, 3),
        "9, 2..3": (2, 3, 9),
        "3,3..3": (3,),
        "-7..3": (2, 3),
    }.items():
        assert chosen_steps(text, EXISTING) == steps
    assert chosen_steps(None, EXISTING) == EXISTING
    assert chosen_steps("-1", (-1, 0)) == (-1,)


@pytest.mark.parametrize("text", ["", "a", "1..2..3", "1-2", "3,,5", "1.5", "4", "6..7", "8..3"])
def test_other_texts_and_steps_that_do_not_exist_are_refused(text):
    message = r"names no steps; accepted: steps, such as 3|there is no step .*: 2, 3, 5, 8, 9"
    with pytest.raises(SettingError, match=message):
        chosen_steps(text, EXISTING)


def test_what_is_printable_stays_and_all_else_is_escaped(capsys):
    plain = "Bohrmaschine ½″ 电钻 \N{NO-BREAK SPACE}[x]"
    assert printable(plain) == plain
    assert printable(HOSTILE) == SHOWN
    assert printable("a\nb\t\r\x7f\udcff\u2028") == "a\\nb\\t\\r\\x7f\\udcff\\u2028"
    assert printable("a\nb\t", keep="\n") == "a\nb\\t"
    print_error(f"{HOSTILE}\n")
    with warnings.catch_warnings():
        warnings.showwarning = print_warning
        warnings.simplefilter("always")
        warnings.warn(HOSTILE, stacklevel=1)
    assert capsys.readouterr().err == f"error: {SHOWN}\\n\nwarning: {SHOWN}\n"


def test_lines_and_tables_show_texts_as_they_are():
    text, table = io.StringIO(), Table(HOSTILE, title=HOSTILE, caption=HOSTILE)
    table.add_row(HOSTILE)
    Console(file=text, width=300).print(f"{HOSTILE}\nerror: nothing", table)
    assert text.getvalue().startswith(f"{SHOWN}\\nerror: nothing\n")
    assert text.getvalue().count(SHOWN) == 5


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_takes_files_of_any_name_and_overwrites_none(verb, tmp_path, capsys):
    path = tmp_path / HOSTILE
    path.parent.mkdir()
    shutil.copy(REPLAY, path)
    before, step = path.read_bytes(), read_recording(path).steps[0]
    words = verb_arguments(verb, path, path.with_suffix(".out"), step=step)
    assert main(words) == 0
    printed = capsys.readouterr()
    assert not set(printed.out + printed.err) & set("\x1b\x07\x9b\u202e")
    if verb != "diff":  # which names no file
        assert SHOWN.removesuffix(".mcap") in printed.out
    written = [file for file in path.parent.iterdir() if file != path]
    if written:
        (out,) = written
        out.write_bytes(b"mine")
        for target in (out, path):
            again = [word.replace(str(out), str(target)) for word in words]
            assert main(again) == 2
            assert "error: " in capsys.readouterr().err
        assert out.read_bytes() == b"mine"
    assert path.read_bytes() == before
    nowhere = tmp_path / "nowhere" / HOSTILE
    assert main(verb_arguments(verb, nowhere, tmp_path / "out")) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert SHOWN in printed.err
    assert printed.err.count("\n") == 1


def test_a_fifo_is_refused_in_one_line_and_not_waited_for(tmp_path, capsys):
    readers = {
        "a.ply": (load_mesh, MeshError),
        "c.yaml": (read_pose, SessionError),
        "d.yaml": (read_depth_frame, SessionError),
    }
    signal.alarm(60)  # which ends a test that waits
    for name, (read, error) in readers.items():
        os.mkfifo(tmp_path / name)
        with pytest.raises(error, match=rf"{name}.* is a FIFO.*; accepted: a file"):
            read(tmp_path / name)
    assert main(["verify", str(tmp_path / "e.mcap")]) == 2
    assert main(["info", str(tmp_path / "e.mcap")]) == 2
    signal.alarm(0)
    shown = capsys.readouterr().err
    assert shown.count("e.mcap") == shown.count("\n") == 2
