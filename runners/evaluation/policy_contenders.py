"""The policies of an evaluation, with the settings and the labels under which they take part."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from chsel.errors import SettingError
from chsel.policies import POLICIES, build_policy, policy_settings
from chsel.policies.policy import Policy
from chsel.problem.settings import build_settings, changed_settings, settings_mapping
from runners.evaluation.contenders import require_label

_LABEL = re.compile(r"(?P<name>\w+)(#[\w+-]+)?")
_ACCEPTED = f"all, or a list of NAME, NAME#MARK or {{name, label, settings}}; {', '.join(POLICIES)}"


@dataclass(frozen=True, eq=False)
class PolicyContender:
    """A registered policy with all of its settings."""

    label: str  # what the table calls it
    name: str
    settings: Mapping[str, Any]

    def policy(self) -> Policy:
        """The policy itself."""
        return build_policy(self.name, self.settings)

    @property
    def config(self) -> dict[str, Any]:
        """As experiment.json has it."""
        return {"name": self.name, "settings": dict(self.settings)}


@dataclass(frozen=True)
class _NamedPolicy:
    """A policy as a configuration writes it down."""

    name: str
    label: str | None = None
    settings: Any = None


def chosen_policies(policies: Any, settings: Mapping[str, Any]) -> dict[str, PolicyContender]:
    """The policies of a configuration's list, or of "all", by label; none for None.

    settings: changes to those that every policy has by default; an entry's own come last. Raises
    SettingError for what does not exist, and for a label that is taken.
    """
    chosen: dict[str, PolicyContender] = {}
    for entry in _entries(policies):
        label = entry.label or entry.name
        require_label(label)
        if label in chosen:
            raise SettingError(f"policies has {label} twice; accepted: {_ACCEPTED}")
        values = changed_settings(policy_settings(entry.name), settings, "policy")
        values = changed_settings(values, entry.settings or {}, f"policies: settings of {label}")
        chosen[label] = PolicyContender(label, entry.name, settings_mapping(values))
    return chosen


def _entries(policies: Any) -> list[_NamedPolicy]:
    if policies is None:
        return []
    if policies == "all":
        policies = list(POLICIES)
    elif isinstance(policies, str):
        policies = [text.strip() for text in policies.split(",")]
    elif isinstance(policies, Mapping):
        policies = [policies]
    if not isinstance(policies, list | tuple) or not policies:
        raise SettingError(f"policies is {policies!r}; accepted: {_ACCEPTED}")
    return [_entry(value) for value in policies]


def _entry(value: Any) -> _NamedPolicy:
    if isinstance(value, Mapping):
        return build_settings(_NamedPolicy, value, "policies")
    match = _LABEL.fullmatch(str(value))
    if match is None:
        raise SettingError(f"policies has {value!r}; accepted: {_ACCEPTED}")
    return _NamedPolicy(match["name"], str(value))
