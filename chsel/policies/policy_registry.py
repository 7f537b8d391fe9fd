"""The policies by name: ours, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from chsel.errors import require_choice, require_instance
from chsel.policies.expected_loss import ExpectedLoss, ExpectedLossSettings
from chsel.policies.grid import Grid, GridSettings
from chsel.policies.hit_chance import HitChance, HitChanceSettings
from chsel.policies.hypothesis_pruning import HypothesisPruning, HypothesisPruningSettings
from chsel.policies.information import Information, InformationSettings
from chsel.policies.nearest_mean import NearestMean, NearestMeanSettings
from chsel.policies.policy import Policy
from chsel.policies.random import RandomAction, RandomSettings
from chsel.policies.voxel_entropy import VoxelEntropy, VoxelEntropySettings
from chsel.problem.settings import changed_settings

GROUP = "chsel.policies"

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
POLICIES = tuple(_OURS)


def policy_settings(name: str) -> Any:
    """The settings of a policy by name."""
    require_choice("policy", name, POLICIES)
    return _OURS[name][1]


def build_policy(name: str, settings: Any = None) -> Policy:
    """A policy by name.

    settings: its settings, or a mapping of changes to those it has by default. Raises SettingError
    for names and values that do not exist.
    """
    default = policy_settings(name)
    if settings is None:
        settings = default
    elif isinstance(settings, Mapping):
        settings = changed_settings(default, settings, "policy")
    kind = type(default)
    require_instance("settings", settings, kind, f"a mapping, or a {kind.__name__}")
    return _OURS[name][0](settings)
