"""Whether this thread computes as IEEE 754 says."""

from __future__ import annotations

import numpy as np

from chsel.errors import EngineError
from chsel.kernels.compiler import compiled

_TINY = np.array([5e-324, 2.3e-308])


def require_ieee_arithmetic() -> None:
    """Raise EngineError if this thread flushes subnormal numbers to zero."""
    if not _keeps_subnormals(_TINY):
        raise EngineError(
            "this thread flushes subnormal numbers to zero, so results would differ from those of "
            "other machines; accepted: IEEE arithmetic (torch.set_flush_denormal(False), and no "
            "library built with -ffast-math)"
        )


@compiled
def _keeps_subnormals(tiny):  # type: ignore[no-untyped-def]
    """As operands, and as results."""
    return tiny[0] > 0.0 and tiny[1] * 0.25 > 0.0
