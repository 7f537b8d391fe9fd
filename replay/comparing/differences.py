"""How two values differ to the bit, in words and in units in the last place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ABSENT = object()
"""Stands for a value that one side does not have."""
_SETTINGS = "config"  # of a session: numbers that people wrote, with no last place to count in
_LONGEST_TEXT = 60
_SIGN = np.uint64(2**63)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A field whose two values differ."""

    field: str  # its name; empty where something as a whole has no counterpart
    text: str  # what is different, with the name
    ulps: int | None = None  # units in the last place, the most over an array; None: not a double


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[Difference]:
    """What differs between two contents, in the order of the first."""
    pairs = (
        difference(name, first.get(name, ABSENT), second.get(name, ABSENT))
        for name in dict.fromkeys([*first, *second])
    )
    return [found for found in pairs if found is not None]


def difference(name: str, first: Any, second: Any) -> Difference | None:
    """How two values differ, or None if they have the same type and the same bits."""
    if _is_equal(first, second):
        return None
    distance = None if name.startswith(_SETTINGS) else _largest_ulps(first, second)
    if _are_alike(first, second):
        text = f"{name}: {_array_difference(first, second)}"
    elif isinstance(first, bytes) and isinstance(second, bytes):
        text = f"{name}: {len(first)} bytes -> {len(second)} others"
    else:
        text = f"{name}: {_shown(first)} -> {_shown(second)}"
        text += "" if distance is None else f" ({distance} ulp)"
    return Difference(field=name, text=text, ulps=distance)


def ulps(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.uint64]:
    """Steps between neighbouring doubles from each number to the other, entry by entry.

    -0.0 is right below 0.0. Of two equal NaN it is 0, as of all numbers with the same bits.
    """
    a, b = _ranks(left), _ranks(right)
    return np.where(a > b, a - b, b - a)


def _is_equal(first: Any, second: Any) -> bool:
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return _are_alike(first, second) and first.tobytes() == second.tobytes()
    if type(first) is not type(second):
        return False
    if isinstance(first, float):
        return np.float64(first).tobytes() == np.float64(second).tobytes()
    return first is second or bool(first == second)


def _are_alike(first: Any, second: Any) -> bool:
    """Whether both are arrays of one type and shape."""
    both = isinstance(first, np.ndarray) and isinstance(second, np.ndarray)
    return both and first.dtype == second.dtype and first.shape == second.shape


def _largest_ulps(first: Any, second: Any) -> int | None:
    """The most units in the last place between two doubles, or arrays of them of one shape."""
    if isinstance(first, float) and isinstance(second, float):
        first, second = np.array([first]), np.array([second])
    if not _are_alike(first, second) or first.dtype != np.float64:
        return None
    return int(ulps(first, second).max(initial=0))


def _array_difference(first: NDArray[Any], second: NDArray[Any]) -> str:
    """In how many entries two arrays of one type and shape differ, and where first."""
    if first.dtype != np.float64:
        unequal = np.flatnonzero((_bytes(first) != _bytes(second)).any(axis=1))
        return f"{len(unequal)} of {first.size} entries, the first at {unequal[0]}"
    steps = ulps(first, second).ravel()
    unequal = np.flatnonzero(steps)
    with np.errstate(invalid="ignore"):
        largest = float(np.nanmax(np.abs(first - second), initial=0.0))
    return (
        f"{len(unequal)} of {first.size} numbers by up to {steps.max()} ulp "
        f"({largest:.3g}), the first at {unequal[0]}"
    )


def _bytes(entries: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes (N, B) of each entry of an array."""
    return np.frombuffer(entries.tobytes(), dtype=np.uint8).reshape(entries.size, -1)


def _ranks(numbers: NDArray[Any]) -> NDArray[np.uint64]:
    """Where each number stands in the order of all doubles."""
    bits = np.ascontiguousarray(numbers, dtype=np.float64).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _shown(value: Any) -> str:
    if value is ABSENT:
        return "absent"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    text = value if isinstance(value, str) and value.isprintable() else repr(value)
    return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 1]}…"
