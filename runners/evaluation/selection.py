"""Which configurations, levels of faults and seeds an evaluation has."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from chsel.errors import SettingError
from runners.evaluation.trial_configurations import TrialConfiguration

MOST_SEEDS = 100_000
SEED_LIMIT = 2**63  # a column of the table holds them
_RANGE = re.compile(r"(\d{1,19})\.\.(\d{1,19})")


def chosen_configurations(
    value: Any, existing: Mapping[str, TrialConfiguration]
) -> tuple[str, ...]:
    """Which of the existing configurations a value names, in the order of all of them.

    A name, a pattern such as drill*, an object (all of its configurations, unless one has the same
    name), "all", or a list of these. Raises SettingError if one of them names none.
    """
    listed = _listed("configurations", value)
    chosen = {name for text in listed for name in _named(text, existing)}
    return tuple(name for name in existing if name in chosen)


def chosen_names(setting: str, value: Any, existing: Iterable[str]) -> tuple[str, ...]:
    """Which of the existing names a setting has, in the order of all of them.

    A name, a pattern such as noise_*, "all", or a list of these. Raises SettingError if one of them
    names none.
    """
    names, chosen = list(existing), set()
    for text in _listed(setting, value):
        named = [name for name in names if text == "all" or fnmatchcase(name, str(text))]
        if not named:
            raise SettingError(
                f"{setting} names {text!r}; accepted: all, a pattern such as {names[0][:3]}*, "
                f"{', '.join(names)}"
            )
        chosen.update(named)
    return tuple(name for name in names if name in chosen)


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


def _named(text: Any, existing: Mapping[str, TrialConfiguration]) -> Iterable[str]:
    if text == "all":
        return existing
    if text in existing:
        return [text]
    matching = [name for name, one in existing.items() if one.object == text]
    matching = matching or [name for name in existing if fnmatchcase(name, str(text))]
    if not matching:
        raise SettingError(
            f"configurations names {text!r}; accepted: all, an object, a pattern such as drill*, "
            f"{', '.join(existing)}"
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
