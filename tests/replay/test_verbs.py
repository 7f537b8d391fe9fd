"""What all verbs share: their names, steps, texts on a terminal, and files they leave alone."""

import shutil
from pathlib import Path

import pytest

from chsel.errors import SettingError
from replay.__main__ import main
from replay.arguments import chosen_steps
from replay.mcap.reader import read_recording
from replay.verbs import VERBS

REPLAY = Path(__file__).resolve().parents[1] / "replays" / "spam_can_icp.mcap"
HOSTILE = "x[/x] [red]:smile: \x1b]0;title\x07\x1b[31m\x9b\u202e.mcap"
SHOWN = "x[/x] [red]:smile: \\x1b]0;title\\x07\\x1b[31m\\x9b\\u202e.mcap"

ARGUMENTS = {
    "accept": ("FILE", "--yes"),
    "compare": ("FILE", "--methods", "icp", "--steps", "STEP", "--save-csv", "OUT.csv"),
    "diff": ("FILE", "OTHER"),
    "export": ("FILE", "--what", "points", "-o", "OUT.npz"),
    "info": ("FILE",),
    "recover": ("FILE", "-o", "OUT.mcap"),
    "step": ("FILE", "--step", "STEP", "-o", "OUT.mcap"),
    "verify": ("FILE", "--step", "STEP"),
    "view": ("FILE", "--save", "OUT.rrd"),
}
assert set(ARGUMENTS) == set(VERBS)


def verb_arguments(verb, file, *, out, step=8, other=None):
    """The verb and its arguments. out: name of what is written, without its suffix."""
    names = {"FILE": str(file), "OTHER": str(other or file), "STEP": str(step)}
    words = (names.get(word, word) for word in ARGUMENTS[verb])
    return [verb, *(word.replace("OUT.", f"{out}.") for word in words)]


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


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_takes_files_of_any_name_and_overwrites_none(verb, tmp_path, capsys):
    path = tmp_path / HOSTILE
    path.parent.mkdir()
    shutil.copy(REPLAY, path)
    before = path.read_bytes()
    step = read_recording(path).steps[0]
    words = verb_arguments(verb, path, out=path.with_suffix(".out"), step=step)
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
    assert main(verb_arguments(verb, nowhere, out=tmp_path / "out")) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert SHOWN in printed.err
    assert printed.err.count("\n") == 1
