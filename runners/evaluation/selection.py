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

    As `chosen_names`, or an object: all of its configurations, unless one has the same name.
    """
    objects: dict[str, list[str]] = {}
    for name, one in existing.items():
        objects.setdefault(one.object, []).append(name)
    return chosen_names("configurations", value, existing, objects)


def chosen_names(
    setting: str, value: Any, existing: Iterable[str], groups: Mapping[str, list[str]] | None = None
) -> tuple[str, ...]:
    """Which of the existing names a setting has, in the order of all of them.

    A name, a pattern such as noise_*, "all", or a list of these. groups: names for several, here
    of objects. Raises SettingError if one of them names none.
    """
    names, chosen = list(existing), set()
    for text in map(str, _listed(setting, value)):
        named = names if text == "all" else [name for name in names if name == text]
        named = named or (groups or {}).get(text, [])
        named = named or [name for name in names if fnmatchcase(name, text)]
        if not named:
            accepted = "all, an object" if groups else "all"
            raise SettingError(
                f"{setting} names {text!r}; accepted: {accepted}, a pattern such as "
                f"{names[0][:3]}*, {', '.join(names)}"
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
    parts = value if isinstance(value, list | tuple) else [value]
    listed = [
        one
        for part in parts
        for one in (map(str.strip, part.split(",")) if isinstance(part, str) else [part])
    ]
    if not listed or any(part is None or part == "" for part in listed):
        raise SettingError(f"{name} is {value!r}; accepted: at least one, or a list")
    return listed


def _seeds(part: Any) -> Iterable[int]:
    match = _RANGE.fullmatch(str(part))
    if match is not None:
        first, last = int(match[1]), int(match[2])
        if first <= last < min(first + MOST_SEEDS, SEED_LIMIT):
            return range(first, last + 1)
    elif re.fullmatch(r"\d{1,20}", str(part)) and int(part) < SEED_LIMIT:
        return [int(part)]
    raise SettingError(f"seeds names {part!r}; accepted: such as 3, [0,1] or 0..9, below 2^63")
