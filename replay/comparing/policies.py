"""The policy of a recording, and others to decide in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from chsel.errors import RecordingError, SettingError
from chsel.policies import build_policy, policy_settings
from chsel.policies.policy import Policy
from chsel.problem.settings import changed_settings, settings_mapping
from replay.mcap.reader import Recording
from replay.registration import setting_change


@dataclass(frozen=True, eq=False)
class NamedPolicy:
    """A policy with the name and the plain settings that make it again."""

    name: str
    settings: Mapping[str, Any]
    policy: Policy


def recorded_policy(recording: Recording) -> NamedPolicy:
    """The policy that steered a session; RecordingError if none did, or it is not installed."""
    config = recording.start.config.get("policy")
    name = config.get("name") if isinstance(config, Mapping) else None
    if not isinstance(config, Mapping) or not isinstance(name, str):
        raise RecordingError(
            f"recording {recording.path} has no policy; accepted: a recording of a steered session"
        )
    settings = {key: value for key, value in config.items() if key != "name"}
    try:
        return _named(name, changed_settings(policy_settings(name), settings, "policy"))
    except SettingError as error:
        raise RecordingError(f"recording {recording.path}: {error}") from error


def other_policy(recording: Recording, name: str, changes: Sequence[str]) -> NamedPolicy:
    """A policy by name with changes such as "stop.spread=0.02".

    Unchanged settings are those of the recording if it is the recorded policy, else those by
    default. Raises SettingError for names and values that do not exist.
    """
    config = recording.start.config.get("policy")
    settings = policy_settings(name)
    if isinstance(config, Mapping) and config.get("name") == name:
        settings = recorded_policy(recording).policy.settings
    for change in changes:
        key, value = setting_change(change)
        for part in reversed(key.removeprefix("policy.").split(".")):
            value = {part: value}
        settings = changed_settings(settings, value, "policy")
    return _named(name, settings)


def _named(name: str, settings: Any) -> NamedPolicy:
    policy = build_policy(name, settings)
    return NamedPolicy(name, settings_mapping(policy.settings), policy)
