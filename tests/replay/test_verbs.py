"""Verbs are found by their modules."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from replay.__main__ import main
from replay.mcap.reader import read_recording
from replay.verbs import ALIASES, VERBS

REPOSITORY = Path(__file__).resolve().parents[2]
RECORDING = REPOSITORY / "tests" / "replays" / "spam_can_icp.mcap"
VERB = '''"""Count the registrations of a recording."""

import argparse

from replay.arguments import path_argument
from replay.console import Console
from replay.mcap.reader import read_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=path_argument)


def run(given: argparse.Namespace) -> int:
    Console().print(str(len(read_recording(given.file).steps)))
    return 0
'''


def test_a_new_verb_is_one_file(tmp_path: Path) -> None:
    for package in ("replay", "chsel"):
        shutil.copytree(
            REPOSITORY / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    (tmp_path / "replay" / "verbs" / "count.py").write_text(VERB)

    def printed(*words: str) -> str:
        command = [sys.executable, "-m", "replay", *words]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout

    assert "Count the registrations of a recording." in printed("--help")
    assert printed("count", str(RECORDING)) == f"{len(read_recording(RECORDING).steps)}\n"


def test_former_names_are_those_of_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(ALIASES.values()) <= set(VERBS)
    assert not set(ALIASES) & set(VERBS)
    for former, verb in ALIASES.items():
        for name in (former, verb):
            with pytest.raises(SystemExit):
                main([name, "--help"])
        assert capsys.readouterr().out.count(VERBS[verb].split(",")[0]) == 2
