"""Names are shown as they are, whatever they are, by every command."""

from __future__ import annotations

import ast
import dataclasses
import io
import json
import re
import shutil
import warnings
from pathlib import Path

import pytest
from rich.table import Table

import replay.rerun.text
from replay.__main__ import main
from replay.console import Console, Progress, TextColumn, print_error, print_warning, printable
from replay.events import SessionStarted
from replay.mcap.reader import read_recording
from replay.verbs import VERBS
from tests.tools.verb_arguments import verb_arguments

REPOSITORY = Path(__file__).resolve().parents[2]
REPLAY = REPOSITORY / "tests" / "replays" / "spam_can_icp.mcap"
HOSTILE = "x[/x] [red]:smile: \x1b]0;title\x07\x1b[31m\x9b\u202e.mcap"
SHOWN = "x[/x] [red]:smile: \\x1b]0;title\\x07\\x1b[31m\\x9b\\u202e.mcap"
PLAIN_PARTS_OF_RICH = {"rich.box", "rich.filesize", "rich.measure", "rich.table"}
PROGRESS_WITHOUT_TEXT = {
    "BarColumn",
    "DownloadColumn",
    "MofNCompleteColumn",
    "TaskID",
    "TimeElapsedColumn",
    "TimeRemainingColumn",
    "TransferSpeedColumn",
}


def uses_of_a_terminal(file: Path) -> set[str]:
    """What a file prints by: modules of rich and builtins that take names for markup or orders."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "rich"}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "rich":
            names = {alias.name for alias in node.names}
            if node.module == "rich.progress":
                found |= names - PROGRESS_WITHOUT_TEXT
            elif node.module not in PLAIN_PARTS_OF_RICH:
                found.add(str(node.module))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found |= {node.func.id} & {"print", "input"}
    return found


@pytest.mark.parametrize("room", ["replay", "runners"])
def test_only_one_file_writes_to_a_terminal(room: str) -> None:
    files = sorted((REPOSITORY / room).rglob("*.py"))
    assert len(files) > 50
    users = {str(file.relative_to(REPOSITORY)): uses_of_a_terminal(file) for file in files}
    ours = users.pop("replay/console.py", {"print", "rich.console"})
    assert {"print", "rich.console"} <= ours
    assert not {file: names for file, names in users.items() if names}


def written(width: int = 300) -> tuple[io.StringIO, Console]:
    text = io.StringIO()
    return text, Console(file=text, width=width)


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def test_results_stand_on_lines_of_their_own_above_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr("sys.stdout", screen)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    assert main(["verify", str(REPLAY), str(REPLAY)]) == 0
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
    told = [line for line in re.split(r"[\r\n]+", plain) if "steps equal" in line]
    assert len(told) == 3
    assert all(line.startswith((f"{REPLAY}: ", "2 recordings: ")) for line in told)


def test_what_is_printable_stays_and_all_else_is_escaped() -> None:
    assert printable("Bohrmaschine ½″ 电钻 \N{NO-BREAK SPACE}[x]") == (
        "Bohrmaschine ½″ 电钻 \N{NO-BREAK SPACE}[x]"
    )
    assert printable(HOSTILE) == SHOWN
    assert printable("a\nb\t\r\x7f\udcff\u2028") == "a\\nb\\t\\r\\x7f\\udcff\\u2028"
    assert printable("a\nb\t", keep="\n") == "a\nb\\t"


def test_a_line_is_one_line() -> None:
    text, console = written()
    console.print(f"{HOSTILE}\nerror: nothing")
    assert text.getvalue() == f"{SHOWN}\\nerror: nothing\n"


def test_tables_show_titles_headings_cells_and_captions_as_they_are() -> None:
    text, console = written()
    table = Table(title=HOSTILE, caption=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    console.print(table)
    assert text.getvalue().count(SHOWN) == 4
    assert not set(text.getvalue()) & set("\x1b\x07\x9b\u202e")


def test_progress_and_status_show_descriptions_as_they_are() -> None:
    text, console = written()
    with Progress(console=console) as progress:
        progress.add_task(HOSTILE, total=1)
    with Progress(TextColumn("at {task.description}"), console=console) as progress:
        progress.add_task(HOSTILE, total=1)
    assert text.getvalue().count(SHOWN) == 2
    assert f"at {SHOWN}" in text.getvalue()
    status = console.status(HOSTILE)
    status.update(f"2 {HOSTILE}")
    console.print(status.renderable)
    assert f"2 {SHOWN}" in text.getvalue()


def test_errors_and_warnings_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_error(f"{HOSTILE}\n")
    with warnings.catch_warnings():
        warnings.showwarning = print_warning
        warnings.simplefilter("always")
        warnings.warn(HOSTILE, stacklevel=1)
    assert capsys.readouterr().err == f"error: {SHOWN}\\n\nwarning: {SHOWN}\n"


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A recording whose path Rich would take for markup, and a terminal for orders."""
    path = tmp_path / HOSTILE
    path.parent.mkdir(parents=True)
    return Path(shutil.copy(REPLAY, path))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_files_of_any_name(
    verb: str, hostile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_info_shows_many_files_of_any_name(
    hostile: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", *[str(hostile)] * 4]) == 0
    assert capsys.readouterr().out.count(SHOWN) == 4


def test_unknown_arguments_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["info", str(REPLAY), "--x[/x]\x1b[31m"])
    assert "unrecognized arguments: --x[/x]\\x1b[31m" in capsys.readouterr().err


@pytest.mark.parametrize("object_name", ["[/x]", "[red]drill[/red] :smile:", "$x$ {y} %s"])
def test_an_object_of_any_name_can_be_probed_again(
    object_name: str, tmp_path: Path, make_events, write
) -> None:
    from runners.probe import main as probe
    from tests.runners.in_process import run

    start = dataclasses.replace(_start(make_events), object=object_name)
    logs = tmp_path / "l[/x]"
    done = run(
        probe,
        "session=recorded",
        f"session.path={write([start, *make_events(steps=2, seed=1)[1:]])}",
        "method=icp",
        "method.iterations=2",
        "recording=mcap",
        f"logs='{logs}'",
    )
    assert done.returncode == 0, done.stderr
    assert f"object: {object_name}" in done.stdout.splitlines()
    (folder,) = (logs / "probe").iterdir()
    assert f"{folder}/" in done.stdout.splitlines()
    assert json.loads((folder / "summary.json").read_text())["object"] == object_name


def _start(make_events) -> SessionStarted:
    start = make_events(steps=2, seed=1)[0]
    assert isinstance(start, SessionStarted)
    return start


def test_the_text_of_a_session_in_rerun_takes_no_name_for_markdown(make_events) -> None:
    name = "a | [b](http://c) *d* `e`"
    start = dataclasses.replace(
        _start(make_events), object=name, config={"x": "\n```\n# heading\n````\n"}
    )
    text = replay.rerun.text.session_markdown(start)
    row = next(line for line in text.splitlines() if line.startswith("| object"))
    assert row == r"| object | **a \| \[b\](http://c) \*d\* \`e\`** |"
    fences = [line for line in text.splitlines() if line and set(line) == {"`"}]
    assert fences.count("`````") == 2
