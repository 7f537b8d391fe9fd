"""Cost and measures as functions of search vectors: what the optimizers ask."""

from __future__ import annotations

import numpy as np
import torch

from chsel.arrays import FloatArray
from chsel.cost import RelaxedCost
from chsel.measures import Measure
from chsel.space import SearchSpace


class Objective:
    """The relaxed cost, and its gradients, over the vectors of a search space."""

    def __init__(self, cost: RelaxedCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""
        with torch.no_grad():
            return self._cost(*self.space.decode(torch.tensor(vectors))).numpy()

    def costs_and_gradients(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Costs (B,) and the defined gradients (B, d) at vectors (B, d)."""
        x = torch.tensor(vectors, requires_grad=True)
        cost = self._cost(*self.space.decode(x))
        (gradient,) = torch.autograd.grad(cost.sum(), x)
        return cost.detach().numpy(), gradient.numpy()

    def measures(self, measure: Measure, vectors: FloatArray) -> FloatArray:
        """Measures (B, k) of vectors (B, d)."""
        with torch.no_grad():
            x = torch.tensor(vectors)
            return np.ascontiguousarray(measure.function(x, *self.space.decode(x)).numpy())

    def measure_gradients(self, measure: Measure, vector: FloatArray) -> FloatArray:
        """Gradients (k, d) of the measures at one vector (d,)."""
        x = torch.tensor(vector[None], requires_grad=True)
        values = measure.function(x, *self.space.decode(x))[0]
        rows = [torch.autograd.grad(value, x, retain_graph=True)[0][0] for value in values]
        return torch.stack(rows).numpy()
