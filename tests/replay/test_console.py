"""Names are shown as they are, whatever they are, by every command."""

from __future__ import annotations

import io
import shutil
import warnings
from pathlib import Path

import pytest
from rich.table import Table

from replay.__main__ import main
from replay.console import Console, print_error, print_warning, printable
from replay.mcap.reader import read_recording
from replay.verbs import VERBS
from tests.tools.verb_arguments import verb_arguments

REPOSITORY = Path(__file__).resolve().parents[2]
REPLAY = REPOSITORY / "tests" / "replays" / "spam_can_icp.mcap"
HOSTILE = "x[/x] [red]:smile: \x1b]0;title\x07\x1b[31m\x9b\u202e.mcap"
SHOWN = "x[/x] [red]:smile: \\x1b]0;title\\x07\\x1b[31m\\x9b\\u202e.mcap"


def written(width: int = 300) -> tuple[io.StringIO, Console]:
    text = io.StringIO()
    return text, Console(file=text, width=width)


def test_what_is_printable_stays_and_all_else_is_escaped():
    assert printable("Bohrmaschine ½″ 电钻 \N{NO-BREAK SPACE}[x]") == (
        "Bohrmaschine ½″ 电钻 \N{NO-BREAK SPACE}[x]"
    )
    assert printable(HOSTILE) == SHOWN
    assert printable("a\nb\t\r\x7f\udcff\u2028") == "a\\nb\\t\\r\\x7f\\udcff\\u2028"
    assert printable("a\nb\t", keep="\n") == "a\nb\\t"


def test_a_line_is_one_line():
    text, console = written()
    console.print(f"{HOSTILE}\nerror: nothing")
    assert text.getvalue() == f"{SHOWN}\\nerror: nothing\n"


def test_tables_show_titles_headings_cells_and_captions_as_they_are():
    text, console = written()
    table = Table(title=HOSTILE, caption=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    console.print(table)
    assert text.getvalue().count(SHOWN) == 4
    assert not set(text.getvalue()) & set("\x1b\x07\x9b\u202e")


def test_errors_and_warnings_are_one_line(capsys):
    print_error(f"{HOSTILE}\n")
    with warnings.catch_warnings():
        warnings.showwarning = print_warning
        warnings.simplefilter("always")
        warnings.warn(HOSTILE, stacklevel=1)
    assert capsys.readouterr().err == f"error: {SHOWN}\\n\nwarning: {SHOWN}\n"


@pytest.fixture
def hostile(tmp_path):
    """A recording whose path Rich would take for markup, and a terminal for orders."""
    path = tmp_path / HOSTILE
    path.parent.mkdir(parents=True)
    return Path(shutil.copy(REPLAY, path))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_files_of_any_name(verb, hostile, tmp_path, capsys):
    out = hostile.with_suffix("")
    step = read_recording(hostile).steps[0]
    assert main(verb_arguments(verb, hostile, Path(f"{out} out"), step=step)) == 0
    printed = capsys.readouterr()
    assert not set(printed.out + printed.err) & set("\x1b\x07\x9b\u202e")
    if verb != "diff":  # which names no file
        assert SHOWN.removesuffix(".mcap") in printed.out
    nowhere = tmp_path / "nowhere" / HOSTILE
    assert main(verb_arguments(verb, nowhere, tmp_path / "out")) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert SHOWN in printed.err
    assert printed.err.count("\n") == 1
    assert printed.err.strip().isprintable()
