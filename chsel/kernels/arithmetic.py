"""Whether this thread computes as IEEE 754 specifies."""

from __future__ import annotations

import numpy as np

from chsel.errors import EngineError
from chsel.kernels.compiler import compiled

_VALUES = np.array([5e-324, 2.3e-308, 1.0, 2.0**-55])  # an array, so that nothing is folded


def require_ieee_arithmetic() -> None:
    """Raise EngineError if this thread flushes subnormal numbers to zero, or rounds otherwise.

    Otherwise than to the nearest number, that is.
    """
    if not _rounds_to_nearest(_VALUES):
        raise EngineError(
            "this thread does not round to the nearest number, so results would differ from those "
            "of other machines; accepted: the usual rounding mode, fesetround(FE_TONEAREST)"
        )
    if not _keeps_subnormals(_VALUES):
        raise EngineError(
            "this thread flushes subnormal numbers to zero, so results would differ from those of "
            "other machines; accepted: IEEE arithmetic (torch.set_flush_denormal(False), and no "
            "library built with -ffast-math)"
        )


@compiled
def _keeps_subnormals(values):  # type: ignore[no-untyped-def]
    """As operands, and as results."""
    return values[0] > 0.0 and values[1] * 0.25 > 0.0


@compiled
def _rounds_to_nearest(values):  # type: ignore[no-untyped-def]
    """Upwards, the sum would be larger; downwards and towards zero, the difference smaller."""
    return values[2] + values[3] == values[2] and values[2] - values[3] == values[2]
