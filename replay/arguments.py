"""Arguments of commands: paths, and the steps that `--steps` names."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from chsel.errors import SettingError

STEPS_HELP = "steps, such as 3, 2..5, 2.., ..5 or 0,4..6; left out: all"
"""For the help of a verb."""

_PART = re.compile(r"(-?\d{1,10})|(-?\d{1,10})?\.\.(-?\d{1,10})?")


def path_argument(text: str) -> Path:
    """Return the path, with ~ for the home folder, which no shell expands in --save=~/FILE."""
    return Path(os.path.expanduser(text))


def chosen_steps(text: str | None, existing: Sequence[int]) -> tuple[int, ...]:
    """Return the existing steps that a text names, in their order; None names all of them.

    A range may reach beyond the steps that exist, but must meet one. Raise SettingError for a
    text of another form, a step that does not exist, and a range without any.
    """
    if text is None:
        return tuple(existing)
    wanted = [step for part in text.split(",") for step in _steps_of(part.strip(), existing)]
    return tuple(step for step in existing if step in set(wanted))


def _steps_of(part: str, existing: Sequence[int]) -> list[int]:
    """Return the existing steps within one part, at least one."""
    match = _PART.fullmatch(part)
    if match is None or not part:
        raise SettingError(f"{part!r} names no steps; accepted: {STEPS_HELP}")
    single, first, last = match.groups()
    if single is not None:
        first = last = single
    low = int(first) if first is not None else min(existing, default=0)
    high = int(last) if last is not None else max(existing, default=0)
    found = [step for step in existing if low <= step <= high]
    if not found:
        accepted = ", ".join(map(str, existing)) or "none"
        raise SettingError(f"there is no step {part}; accepted: {accepted}")
    return found
