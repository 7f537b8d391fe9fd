"""The files and commands on a page of docs/, as a reader would take them over."""

import os
import re
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
_BLOCK = re.compile(r"^```(?P<language>\w+)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
_NAMED = re.compile(r"`(?P<name>[\w./-]+\.\w+)`:\n\n\Z")


def section(page, title):
    """The text of a page below a heading of the second level, up to the next."""
    sections = re.split(r"^## (.+)\n", (DOCS / page).read_text(), flags=re.MULTILINE)
    return dict(zip(sections[1::2], sections[2::2], strict=True))[title]


def write_files(page, folder):
    """Write every block of a page that a line such as "`name.py`:" stands before; their paths."""
    text, written = (DOCS / page).read_text(), []
    for block in _BLOCK.finditer(text):
        if named := _NAMED.search(text[: block.start()]):
            path = folder / named["name"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block["text"])
            written.append(path)
    return written


def commands(page):
    """The lines of all sh blocks of a page, in order; lines that a backslash continues are one."""
    blocks = _BLOCK.finditer((DOCS / page).read_text())
    joined = "".join(block["text"] for block in blocks if block["language"] == "sh")
    return joined.replace("\\\n", " ").splitlines()


def shell(command, folder, **variables):
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
