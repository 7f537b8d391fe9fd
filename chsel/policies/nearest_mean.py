"""The action whose way passes nearest to where the object is on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.outline import in_order
from chsel.problem.poses import Poses, rotated
from chsel.problem.surface import object_centre


@dataclass(frozen=True)
class NearestMeanSettings(PolicySettings):
    """All settings of the policy."""


class NearestMean(ConfiguredPolicy[NearestMeanSettings]):
    """Aims the hand's origin at the mean of the object's centre over the belief."""

    settings_class = NearestMeanSettings
    is_gain = False

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Minus the least distance (A,) of the way to the mean centre, metres."""
        mean = mean_centre(problem)
        actions = problem.actions.world_from_hand
        ahead = actions[:, :3, 2]  # along which the hand moves
        offset = mean - actions[:, :3, 3]
        along = in_order(offset * ahead)
        along = np.minimum(np.maximum(along, 0.0), problem.actions.length)
        beside = offset - along[:, None] * ahead
        return -np.sqrt(in_order(beside * beside))


def mean_centre(problem: DecisionProblem) -> FloatArray:
    """The mean (3,) of the object's centre over the belief, world frame, metres."""
    belief = problem.belief
    poses = Poses.of(belief.object_from_world)
    turns = np.swapaxes(poses.rotations, 1, 2)
    centres = rotated(turns, object_centre(problem.sdf) - poses.translations)  # (K, 3)
    return in_order(belief.weights * centres.T)
