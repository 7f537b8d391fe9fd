"""Adam (Kingma and Ba, 2015), element by element, so that its bits do not depend on the machine."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray


class Adam:
    """First and second moments of gradients, with bias correction."""

    def __init__(
        self, rate: float, *, beta1: float = 0.9, beta2: float = 0.999, epsilon: float = 1e-8
    ) -> None:
        self._rate, self._epsilon = rate, epsilon
        self._beta1, self._beta2 = beta1, beta2
        self._first = self._second = np.zeros(())
        self._power1 = self._power2 = 1.0

    def step(self, gradient: FloatArray) -> FloatArray:
        """What to subtract from the variables to go downhill."""
        self._first = self._beta1 * self._first + (1.0 - self._beta1) * gradient
        self._second = self._beta2 * self._second + (1.0 - self._beta2) * gradient * gradient
        self._power1 *= self._beta1
        self._power2 *= self._beta2
        mean = self._first / (1.0 - self._power1)
        variance = self._second / (1.0 - self._power2)
        return self._rate * mean / (np.sqrt(variance) + self._epsilon)
