"""Coverage, plausibility and plausible diversity of hypotheses (CHSEL, Eqs. 3 to 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import SettingError
from chsel.evaluation.error import EvaluationError


@dataclass(frozen=True)
class PlausibleDiversity:
    """coverage: the mean over plausible poses of the distance to the nearest hypothesis;
    plausibility: the mean over hypotheses of that to the nearest plausible pose; mm^2.
    """

    coverage: float
    plausibility: float

    @property
    def diversity(self) -> float:
        """PD = coverage + plausibility, mm^2; 0 is best."""
        return self.coverage + self.plausibility

    @property
    def root(self) -> float:
        """The square root of PD, mm, which compares with lengths."""
        return math.sqrt(self.diversity)


def plausible_diversity(distances: FloatArray) -> PlausibleDiversity:
    """The metrics of distances d (B, P) in mm^2, of hypotheses and plausible poses.

    Raises EvaluationError if there is none of either.
    """
    if distances.ndim != 2 or 0 in distances.shape:
        raise EvaluationError(
            f"distances have shape {distances.shape}; accepted: (B, P), at least one hypothesis "
            "and one plausible pose"
        )
    nearest_hypothesis, nearest_member = distances.min(axis=0), distances.min(axis=1)
    return PlausibleDiversity(float(nearest_hypothesis.mean()), float(nearest_member.mean()))


def cheapest(costs: FloatArray, quantile: float) -> np.ndarray:
    """Flags (B,) of hypotheses whose cost is at most this quantile of costs (B,); 1: all."""
    if not 0.0 < quantile <= 1.0:
        raise SettingError(f"quantile is {quantile}; accepted: above 0, at most 1")
    return np.asarray(costs <= np.quantile(costs, quantile, method="higher"))
