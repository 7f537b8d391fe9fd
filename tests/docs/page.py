"""The files, changes and commands on a page of docs/, as a reader would take them over."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
_BLOCK = re.compile(r"^```(?P<language>\w+)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
_NAMED = re.compile(r"`(?P<name>[\w./-]+\.\w+)`:\n\n\Z")


def section(page: str, title: str) -> str:
    """The text of a page below a heading of the second level, up to the next."""
    sections = re.split(r"^## (.+)\n", (DOCS / page).read_text(), flags=re.MULTILINE)
    return dict(zip(sections[1::2], sections[2::2], strict=True))[title]


def named_blocks(text: str) -> Iterator[tuple[str, str, str]]:
    """Name, language and text of every block that a line such as "`name.py`:" stands before."""
    for block in _BLOCK.finditer(text):
        if named := _NAMED.search(text[: block.start()]):
            yield named["name"], block["language"], block["text"]


def write_files(page: str, folder: Path) -> list[Path]:
    """Write every named block of a page; their paths."""
    return take_over((DOCS / page).read_text(), folder)


def take_over(text: str, folder: Path) -> list[Path]:
    """Write every named block of a text; one of the language diff changes the file there."""
    written = []
    for name, language, block in named_blocks(text):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(changed(path.read_text(), block, name) if language == "diff" else block)
        written.append(path)
    return written


def changed(text: str, diff: str, name: str) -> str:
    """A file's text after a diff, whose parts between lines "@@" each fit in one place alone."""
    for part in diff.split("@@\n"):
        lines = part.splitlines(keepends=True)
        before = "".join(line[1:] for line in lines if line[0] != "+")
        after = "".join(line[1:] for line in lines if line[0] != "-")
        places = text.count(before)
        assert places == 1, f"{name} has {places} places for\n{part}"
        text = text.replace(before, after)
    return text


def commands(page: str) -> list[str]:
    """The commands of a page, see `commands_in`."""
    return commands_in((DOCS / page).read_text())


def commands_in(text: str) -> list[str]:
    """The lines of all sh blocks, in order; lines that a backslash continues are one."""
    blocks = _BLOCK.finditer(text)
    joined = "".join(block["text"] for block in blocks if block["language"] == "sh")
    return joined.replace("\\\n", " ").splitlines()


def shell(command: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command of a page in a folder; pip installs into its folder `site`, and offline."""
    binaries = str(Path(sys.executable).parent)
    environment = {
        **os.environ,
        "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(folder / "site"),
        "PIP_TARGET": str(folder / "site"),
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads it as: no isolation
        "PIP_NO_INDEX": "1",
        "COLUMNS": "120",
        "OMP_NUM_THREADS": "1",
        **variables,
    }
    return subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
