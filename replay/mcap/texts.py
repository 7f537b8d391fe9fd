"""Texts of a recording: what a terminal or a viewer shows as it is, without control characters."""

from __future__ import annotations

import re

from chsel.errors import RecordingError

LONGEST_NAME = 1000
LONGEST = 2**20
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def check_text(what: str, text: str, *, longest: int = LONGEST) -> None:
    """Raise RecordingError for control characters but tab and newline, and for what is too long."""
    if len(text) > longest:
        raise RecordingError(f"{what} has {len(text)} characters; accepted: at most {longest}")
    found = _CONTROL.search(text)
    if found:
        raise RecordingError(
            f"{what} holds the character {found[0]!r} at {found.start()}; accepted: text without "
            "control characters"
        )


def one_line(text: str) -> str:
    """Return a text as errors quote it: one line, of bounded length, without controls."""
    line = _CONTROL.sub(lambda found: repr(found[0])[1:-1], " ".join(text.split()))
    return line if len(line) <= LONGEST_NAME else f"{line[:LONGEST_NAME]}..."


def check_name(what: str, text: str) -> None:
    """Raise RecordingError unless a text is a short name on one line."""
    check_text(what, text, longest=LONGEST_NAME)
    if "\n" in text:
        raise RecordingError(f"{what} is {text!r}; accepted: a name on one line")
