"""How two arrays differ, in words and in units in the last place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIGN = np.uint64(2**63)


def ulps(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.uint64]:
    """Steps between neighbouring doubles from each number to the other, entry by entry.

    -0.0 is right below 0.0. Of two equal NaN it is 0, as of all numbers with the same bits.
    """
    a, b = _ranks(left), _ranks(right)
    return np.where(a > b, a - b, b - a)


def apart(recorded: NDArray[Any], found: NDArray[Any]) -> int:
    """The most units in the last place between two arrays of one shape; 0 if none are doubles."""
    if recorded.dtype != np.float64 or recorded.size == 0 or recorded.shape != found.shape:
        return 0
    return int(ulps(recorded, found).max())


def difference(name: str, recorded: NDArray[Any], found: NDArray[Any]) -> str | None:
    """What is different between two arrays, or None if they are equal to the bit."""
    if recorded.dtype != found.dtype or recorded.shape != found.shape:
        return f"{name}: {found.dtype} {found.shape} instead of {recorded.dtype} {recorded.shape}"
    if recorded.tobytes() == found.tobytes():
        return None
    if recorded.dtype != np.float64:
        unequal = np.flatnonzero(recorded.ravel() != found.ravel())
        return f"{name}: {len(unequal)} of {recorded.size} entries, the first at {unequal[0]}"
    steps = ulps(recorded, found).ravel()
    unequal = np.flatnonzero(steps)
    with np.errstate(invalid="ignore"):
        largest = float(np.nanmax(np.abs(recorded - found), initial=0.0))
    return (
        f"{name}: {len(unequal)} of {recorded.size} numbers by up to {steps.max()} ulp "
        f"({largest:.3g}), the first at {unequal[0]}"
    )


def _ranks(numbers: NDArray[Any]) -> NDArray[np.uint64]:
    """Where each number stands in the order of all doubles."""
    bits = np.ascontiguousarray(numbers, dtype=np.float64).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)
