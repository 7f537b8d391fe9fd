"""Whether a set of hypotheses spreads as far as it errs: the rank of the truth among them.

If the true pose could as well be one of the B hypotheses, then its place among all B + 1, ordered
by how far each is from the others on average, is uniform: the multivariate rank histogram of
ensemble forecasts (Gneiting, Stanberry, Grimit, Held and Johnson, 2008, "Assessing probabilistic
forecasts of multivariate quantities", TEST 17; with the mean distance as pre-rank). Poses that a
symmetry of the object makes alike are at distance 0, as it is their surfaces that are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.arrays import FloatArray
from chsel.evaluation.error import EvaluationError
from chsel.evaluation.surface_distance import SurfaceDistance
from chsel.pose import inverse


@dataclass(frozen=True)
class Calibration:
    """rank: share of the B + 1 poses that are at least as far out as the true one, in (0, 1].

    Uniform over many registrations if calibrated; small ones say that the truth lies outside of
    the spread, as of a set too narrow or off. spread, error: root mean squared surface distances,
    mm, between hypotheses, and from them to the truth.
    """

    rank: float
    spread: float
    error: float

    def within(self, level: float = 0.05) -> bool:
        """Whether the truth is within the set's spread: not among the outermost `level`."""
        return self.rank > level


def calibration(
    distance: SurfaceDistance, object_from_world: FloatArray, world_from_object: FloatArray
) -> Calibration:
    """Of hypotheses (B, 4, 4) and the true pose (4, 4). Raises EvaluationError for fewer than 2."""
    count = len(object_from_world)
    if count < 2:
        raise EvaluationError(f"calibration of {count} hypotheses; accepted: at least 2")
    poses = np.concatenate([object_from_world, inverse(world_from_object[None])])
    distances = distance.between(poses, inverse(poses))
    distances = (distances + distances.T) / 2.0
    np.fill_diagonal(distances, 0.0)
    lengths = np.sqrt(distances)
    outwards = lengths.sum(axis=1) / count
    # Rounding must not rank equal poses.
    rank = (outwards >= outwards[-1] * (1.0 - 1e-9)).mean()
    between = distances[:-1, :-1].sum() / (count * (count - 1))
    return Calibration(
        float(rank), float(np.sqrt(between)), float(np.sqrt(distances[-1, :-1].mean()))
    )
