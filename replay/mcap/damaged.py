"""The error of a recording that is not whole, and what can be done about it."""

from __future__ import annotations

import shlex
from pathlib import Path

from chsel.errors import RecordingError


class DamagedRecordingError(RecordingError):
    """A recording is unfinished or damaged. damage: how, without what can be done about it."""

    def __init__(self, path: Path, damage: str) -> None:
        super().__init__(f"recording {path} {damage}; {recover_hint(path)}")
        self.damage = damage


def recover_hint(path: Path) -> str:
    """The command that saves what is whole of a file."""
    return f"`python -m replay recover {shlex.quote(str(path))} -o OUT` saves what is whole"
