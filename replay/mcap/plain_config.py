"""A session's configuration as JSON, both ways: plain values of bounded size, and no other."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from chsel.errors import RecordingError
from replay.mcap.texts import check_text

LONGEST = 2**20  # characters of JSON
DEEPEST = 32  # mappings and lists within one another
_LARGEST = 2**64  # of whole numbers: seeds are below it


def config_to_json(config: Mapping[str, Any]) -> str:
    """The configuration as JSON, in its own order; RecordingError for what JSON would change."""
    _check_plain("config", dict(config), 0)
    text = json.dumps(dict(config), ensure_ascii=False, allow_nan=False)
    _check_length(text)
    return text


def config_from_json(text: str) -> dict[str, Any]:
    """The configuration that `config_to_json` wrote; RecordingError for any other text."""
    _check_length(text)
    try:
        config = json.loads(text, object_pairs_hook=_without_repeats, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise RecordingError(f"its configuration is no JSON as accepted: {reason}") from None
    if not isinstance(config, dict):
        raise RecordingError("its configuration is no mapping")
    _check_plain("config", config, 0)
    return config


def _check_length(text: str) -> None:
    if len(text) > LONGEST:
        raise RecordingError(
            f"the configuration has {len(text)} characters; accepted: at most {LONGEST}"
        )


def _check_plain(where: str, value: Any, depth: int) -> None:
    """Raise RecordingError for what JSON would drop or change, or what is out of bounds."""
    if depth > DEEPEST:
        raise RecordingError(f"config is nested deeper than {DEEPEST}; accepted: at most that")
    if isinstance(value, dict):
        for name, item in value.items():
            if not isinstance(name, str):
                raise RecordingError(f"{where} has the key {name!r}; accepted: text")
            check_text(f"a key of {where}", name)
            _check_plain(f"{where}.{name}", item, depth + 1)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _check_plain(f"{where}[{index}]", item, depth + 1)
    elif isinstance(value, str):
        check_text(where, value)
    elif isinstance(value, float) and not math.isfinite(value):
        raise RecordingError(f"{where} is {value}; accepted: finite numbers")
    elif isinstance(value, int) and abs(value) > _LARGEST:
        raise RecordingError(f"{where} is too large; accepted: whole numbers up to 2**64")
    elif not (value is None or isinstance(value, bool | int | float)):
        kind = type(value).__name__
        raise RecordingError(f"{where} is of type {kind}; accepted: text, numbers, lists, mappings")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        raise ValueError("a mapping has a key twice")
    return mapping


def _whole(digits: str) -> int:
    """A whole number; its digits are counted first, as reading very many takes very long."""
    if len(digits) > len(str(-_LARGEST)):
        raise ValueError(f"a whole number has {len(digits)} digits")
    return int(digits)
