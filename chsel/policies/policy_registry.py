"""The policies by name: ours, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from chsel.policies.expected_loss import ExpectedLoss, ExpectedLossSettings
from chsel.policies.grid import Grid, GridSettings
from chsel.policies.hit_chance import HitChance, HitChanceSettings
from chsel.policies.hypothesis_pruning import HypothesisPruning, HypothesisPruningSettings
from chsel.policies.information import Information, InformationSettings
from chsel.policies.nearest_mean import NearestMean, NearestMeanSettings
from chsel.policies.policy import Policy, PolicySettings
from chsel.policies.random import RandomAction, RandomSettings
from chsel.policies.voxel_entropy import VoxelEntropy, VoxelEntropySettings
from chsel.problem.named_choices import NamedChoices

_OURS: dict[str, tuple[Callable[[Any], Policy], Any]] = {
    "grid": (Grid, GridSettings()),
    "random": (RandomAction, RandomSettings()),
    "nearest_mean": (NearestMean, NearestMeanSettings()),
    "hit_chance": (HitChance, HitChanceSettings()),
    "voxel_entropy": (VoxelEntropy, VoxelEntropySettings()),
    "hypothesis_pruning": (HypothesisPruning, HypothesisPruningSettings()),
    "information": (Information, InformationSettings()),
    "expected_loss": (ExpectedLoss, ExpectedLossSettings()),
}


def _lacks(policy: Any) -> str | None:
    """What an object with settings lacks to be a policy, and what is accepted."""
    if not isinstance(policy.settings, PolicySettings):
        return "settings of another class; accepted: one derived from PolicySettings"
    if not callable(getattr(policy, "decide", None)):
        return "no `decide`; accepted: decide(problem)"
    return None


_CHOICES = NamedChoices[Policy](
    "policy", "chsel.policies", "docs/writing_a_policy.md", _OURS, _lacks
)
OURS = tuple(_OURS)
POLICIES = _CHOICES.names


def policy_settings(name: str) -> Any:
    """The settings of a policy by name. Raises SettingError for a name that does not exist."""
    return _CHOICES.entry(name)[1]


def build_policy(name: str, settings: Any = None) -> Policy:
    """A policy by name.

    settings: its settings, or a mapping of changes to those it has by default. Raises SettingError
    for names and values that do not exist, and for a name of ours that an installed package gives
    to a policy, too.
    """
    return _CHOICES.build(name, settings, policy_settings(name))
