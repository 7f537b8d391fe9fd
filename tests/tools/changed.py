"""`python -m tests.tools.changed`: the tests of the rooms that the working tree changes.

Changed is what differs from the last commit, and files that git does not know yet. A file
`chsel/problem/points.py` is tested by the files in `tests/chsel/problem/`, those named after it
first; a page or a program in `examples/` is tested by `tests/docs/`. Tests that have not begun
after 12 seconds are skipped, which the last line counts: `make test` runs them.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 12.0


def changed_files():
    """Return the paths of all changed files, relative to the repository."""
    listings = ["diff --name-only -z HEAD", "ls-files --others --exclude-standard -z"]
    texts = [subprocess.check_output(["git", *each.split()], cwd=ROOT) for each in listings]
    return [Path(name) for text in texts for name in text.decode().split("\0") if name]


def tests_of(file):
    """Return the test files of a changed file's room: those named after it, and the others."""
    top = file.parts[0]
    words = {file.stem.removeprefix("test_")}
    if top in ("docs", "examples") or file.suffix == ".md":
        folder = ROOT / "tests" / "docs"
    elif top == "conf":
        folder = ROOT / "tests" / "runners"
    elif top == "tests":
        folder = ROOT / file.parent
    elif top in ("chsel", "replay", "runners"):
        folder = ROOT / "tests" / file.parent
    else:
        return [], []
    while not folder.is_dir():  # the tests of some folders lie with those of their parent
        words.add(folder.name)
        folder = folder.parent
    files = sorted(folder.glob("test_*.py"))
    named = [
        test
        for test in files
        if any(word in test.stem or test.stem.removeprefix("test_") in word for word in words)
    ]
    return named, [test for test in files if test not in named]


class Ordered:
    """A plugin of pytest that takes test files in a given order until their time is over."""

    def __init__(self, files):
        self.files = files
        self.end = 0.0

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        items.sort(key=lambda item: self.files.index(item.path))
        self.end = time.monotonic() + SECONDS

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self):
        if time.monotonic() > self.end:
            pytest.skip(f"not begun after {SECONDS:g} s; make test runs it")


def main():
    """Run the tests of all changed files."""
    argparse.ArgumentParser(prog="python -m tests.tools.changed", description=__doc__).parse_args()
    rooms = [tests_of(file) for file in changed_files()]
    named, others = ([test for room in rooms for test in room[n]] for n in (0, 1))
    files = list(dict.fromkeys([*named, *others]))
    if not files:
        print("no room with tests is changed")
        return 0
    return pytest.main(["-x", "-rs", *map(str, files)], plugins=[Ordered(files)])


if __name__ == "__main__":
    sys.exit(main())
