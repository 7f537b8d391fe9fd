"""Which configurations and seeds an evaluation has."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any

from chsel.errors import SettingError
from runners.sessions.configurations import CONFIGURATIONS, fitting_configurations

MOST_SEEDS = 100_000
SEED_LIMIT = 2**63  # a column of the table holds them
_RANGE = re.compile(r"(\d{1,19})\.\.(\d{1,19})")


def chosen_configurations(value: Any) -> tuple[str, ...]:
    """The configurations that a value names, in the order of all of them.

    A name, a pattern such as drill*, an object (all of its configurations, unless one has the same
    name), "all", or a list of these. Raises SettingError if one of them names none.
    """
    chosen = {name for text in _listed("configurations", value) for name in _named(text)}
    return tuple(name for name in CONFIGURATIONS if name in chosen)


def chosen_seeds(value: Any) -> tuple[int, ...]:
    """The seeds that a value names, ascending: 3, [0, 1], "0..9" or a list of these."""
    chosen: set[int] = set()
    for part in _listed("seeds", value):
        chosen.update(_seeds(part))
    return tuple(sorted(chosen))


def _listed(name: str, value: Any) -> list[Any]:
    parts = list(value) if isinstance(value, list | tuple) else [value]
    parts = [one for part in parts for one in _split(part)]
    if not parts or any(part is None or part == "" for part in parts):
        raise SettingError(f"{name} is {value!r}; accepted: at least one, or a list")
    return parts


def _split(part: Any) -> list[Any]:
    return [text.strip() for text in part.split(",")] if isinstance(part, str) else [part]


def _named(text: Any) -> Iterable[str]:
    if text == "all":
        return CONFIGURATIONS
    if text in CONFIGURATIONS:
        return [text]
    matching = fitting_configurations(text)
    matching = matching or [name for name in CONFIGURATIONS if fnmatchcase(name, str(text))]
    if not matching:
        raise SettingError(
            f"configurations names {text!r}; accepted: all, an object, a pattern such as drill*, "
            f"{', '.join(CONFIGURATIONS)}"
        )
    return matching


def _seeds(part: Any) -> Iterable[int]:
    match = _RANGE.fullmatch(str(part))
    if match is not None:
        first, last = int(match[1]), int(match[2])
        if first <= last < min(first + MOST_SEEDS, SEED_LIMIT):
            return range(first, last + 1)
    elif re.fullmatch(r"\d{1,20}", str(part)) and int(part) < SEED_LIMIT:
        return [int(part)]
    raise SettingError(f"seeds names {part!r}; accepted: such as 3, [0,1] or 0..9, below 2^63")
