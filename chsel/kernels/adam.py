"""One step of Adam (Kingma and Ba, 2015)."""

from __future__ import annotations

import numpy as np

from chsel.kernels.compiler import leaf

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-8


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):  # type: ignore[no-untyped-def]
    """How far to go down a slope along coordinate j; updates its moments (2, d).

    powers: beta_1 and beta_2 to the power of the steps taken, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)
