"""The scores by which policies compare actions, and all policies by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, Policy, PolicySettings
from chsel.policies.voxel_entropy import VoxelEntropy, VoxelEntropySettings
from chsel.problem.poses import Poses, rotated
from chsel.problem.settings import Entry, NamedChoices
from chsel.problem.streams import Purpose, uniforms
from chsel.problem.surface import in_order, object_centre


def grid(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Minus the place (A,) of each action among those offered: their order, as the paper probes."""
    return -np.arange(len(problem.actions), dtype=np.float64)


def random(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Return numbers (A,), uniform in [0, 1), from the problem's stream."""
    return uniforms(problem.key.stream(Purpose.POLICY), 0.0, upper=1.0, shape=len(problem.actions))


def nearest_mean(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Minus the least distance (A,), metres, of the hand's way to the object's mean centre."""
    poses = Poses.of(problem.belief.object_from_world)
    turns = np.swapaxes(poses.rotations, 1, 2)
    centres = rotated(turns, object_centre(problem.sdf) - poses.translations)  # (K, 3), world
    actions = problem.actions.world_from_hand
    ahead = actions[:, :3, 2]  # along which the hand moves
    offset = in_order(problem.belief.weights * centres.T) - actions[:, :3, 3]
    along = np.minimum(np.maximum(in_order(offset * ahead), 0.0), problem.actions.length)
    beside = offset - along[:, None] * ahead
    return -np.sqrt(in_order(beside * beside))


def hit_chance(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Weight (A,) of the poses in which the hand meets the object."""
    return forecast.hit_chance


def hypothesis_pruning(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Expected weight (A,), from 0 to 1, that the outcome rules out (Javdani et al., ICRA 2013).

    Poses survive by how likely the outcome is under them, noisily ("weighted hypothesis pruning").
    The gain is adaptive submodular, so greedy choice is near to the best sequence of actions.
    """
    return np.maximum(1.0 - forecast.gains.surviving, 0.0)


def information(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Information (A,) between pose and outcome, nats: at most the entropy of the belief."""
    return forecast.gains.information


def expected_loss(problem: DecisionProblem, forecast: Forecast) -> FloatArray:
    """Expected decrease (A,) of the mean distance of two surfaces, metres; 0 for an increase."""
    weights = problem.belief.weights
    loss = float(in_order(weights * in_order(weights * forecast.distances)))
    return np.maximum(loss - forecast.gains.loss, 0.0)


def _rated_by(score: Callable[..., FloatArray], *, is_gain: bool = True) -> Entry[Policy]:
    """Return the class of policies that rate actions by a score, with the shared settings."""
    names = {"settings_class": PolicySettings, "rate": staticmethod(score), "is_gain": is_gain}
    return type(score.__name__, (ConfiguredPolicy,), names), PolicySettings()


def _lacks(policy: Any) -> str | None:
    """Return why an object is not a policy, and what is accepted; None if it is one."""
    if not isinstance(policy.settings, PolicySettings):
        return "settings of another class; accepted: one derived from PolicySettings"
    if not callable(getattr(policy, "decide", None)):
        return "no `decide`; accepted: decide(problem)"
    return None


_OURS: dict[str, Entry[Policy]] = {
    "grid": _rated_by(grid, is_gain=False),
    "random": _rated_by(random, is_gain=False),
    "nearest_mean": _rated_by(nearest_mean, is_gain=False),
    "hit_chance": _rated_by(hit_chance),
    "voxel_entropy": (VoxelEntropy, VoxelEntropySettings()),
    "hypothesis_pruning": _rated_by(hypothesis_pruning),
    "information": _rated_by(information),
    "expected_loss": _rated_by(expected_loss),
}
OURS = tuple(_OURS)
_CHOICES = NamedChoices[Policy](
    "policy", "chsel.policies", page="docs/writing_a_policy.md", ours=_OURS, lacks=_lacks
)
POLICIES = _CHOICES.names
build_policy, policy_settings = _CHOICES.build, _CHOICES.settings
