"""Methods and policies by name and settings: those of a recording, and others in their place."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import yaml

from chsel.errors import RecordingError, SettingError, require_choice
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.method import Method
from chsel.policies import POLICIES, build_policy, policy_settings
from chsel.policies.policy import Policy
from chsel.problem.settings import PRESETS, changed_settings, settings_mapping
from replay.mcap.reader import Recording

LABELS_HELP = "NAME, NAME@PRESET, NAME#MARK or NAME@PRESET#MARK; the mark tells equal ones apart"
_LABEL = re.compile(r"(?P<name>[\w.-]+)(@(?P<preset>\w+))?(#[\w.+-]+)?")
_KEYS = re.compile(r"[\w.]+")

Made = TypeVar("Made")


class Choosable(NamedTuple, Generic[Made]):
    """A kind of thing that is chosen by name and settings: methods, or policies."""

    name: str  # also of its group in a session's configuration
    names: tuple[str, ...]
    settings: Callable[..., Any]  # by name and preset
    build: Callable[..., Made]


METHOD: Choosable[Method] = Choosable(
    "method", METHODS, settings=preset_settings, build=build_method
)
POLICY: Choosable[Policy] = Choosable(
    "policy", POLICIES, settings=policy_settings, build=build_policy
)


@dataclass(frozen=True, eq=False)
class Choice(Generic[Made]):
    """A method or policy that takes part."""

    kind: Choosable[Made]
    label: str  # by which tables name it
    name: str
    settings: Any  # its dataclass
    preset: str = ""  # that the label names
    changes: tuple[str, ...] = ()  # of the settings, as they were typed

    @property
    def config(self) -> dict[str, Any]:
        """Name and settings in the form of a recording's configuration."""
        return {"name": self.name, **settings_mapping(self.settings)}

    def build(self) -> Made:
        """Return the method or policy itself."""
        return self.kind.build(self.name, self.settings)


def recorded_method(recording: Recording) -> Choice[Method]:
    """Return the recorded method; raise RecordingError without settings, or if it is unknown."""
    return _recorded(recording, METHOD)


def recorded_policy(recording: Recording) -> Choice[Policy]:
    """Return the policy that steered; raise RecordingError if none did, or it is not installed."""
    return _recorded(recording, POLICY)


def is_recorded(recording: Recording, choice: Choice[Any]) -> bool:
    """Return whether name and settings are those of the recording."""
    try:
        return choice.config == _recorded(recording, choice.kind).config
    except RecordingError:
        return False


def chosen(
    recording: Recording, kind: Choosable[Made], *, words: Sequence[str]
) -> list[Choice[Made]]:
    """Return methods or policies by labels such as "chsel@paper" or "chsel#small", and changes.

    Without a preset, settings are those of the recording for its own method or policy, else those
    of its preset. A change "KEY=VALUE" applies to every label that has the setting,
    "LABEL:KEY=VALUE" to one. Raise SettingError for what does not exist, or fits no label.
    """
    labels = [word for word in words if "=" not in word]
    if not labels:
        raise SettingError(f"no {kind.name} is named; accepted: {', '.join(kind.names)}")
    choices: dict[str, Choice[Made]] = {}
    for label in labels:
        if label in choices:
            raise SettingError(f"{label} is named twice; accepted: {LABELS_HELP}")
        choices[label] = _choice(recording, kind, label=label)
    for word in words:
        if "=" in word:
            _change(choices, kind, word=word)
    return list(choices.values())


def _recorded(recording: Recording, kind: Choosable[Made]) -> Choice[Made]:
    config = recording.start.config.get(kind.name)
    name = config.get("name") if isinstance(config, Mapping) else None
    if not isinstance(config, Mapping) or not isinstance(name, str):
        raise RecordingError(
            f"recording {recording.path} does not have the settings of a {kind.name}; accepted: "
            "one that has"
        )
    try:
        settings = {key: value for key, value in config.items() if key != "name"}
        made = changed_settings(kind.settings(name), settings, where=kind.name)
        return Choice(kind, name, name=name, settings=made)
    except SettingError as error:
        raise RecordingError(f"recording {recording.path}: {error}") from error


def _choice(recording: Recording, kind: Choosable[Made], *, label: str) -> Choice[Made]:
    """Return the choice that a label names, before any change."""
    match = _LABEL.fullmatch(label)
    if match is None:
        raise SettingError(f"{label!r} is not a {kind.name}; accepted: {LABELS_HELP}")
    name, preset = match["name"], match["preset"]
    require_choice(kind.name, name, accepted=kind.names)
    config = recording.start.config
    group = config.get("preset")
    recorded = config.get(kind.name)
    if preset is None and isinstance(recorded, Mapping) and recorded.get("name") == name:
        return Choice(kind, label, name=name, settings=_recorded(recording, kind).settings)
    usual = group.get("name") if isinstance(group, Mapping) else None
    usual = usual if usual in PRESETS else "default"
    return Choice(
        kind, label, name=name, settings=kind.settings(name, preset or usual), preset=preset or ""
    )


def _change(choices: dict[str, Choice[Made]], kind: Choosable[Made], *, word: str) -> None:
    """Lay a change over the settings of all labels that have it, or of the one that it names."""
    place, _, text = word.partition("=")
    one, colon, key = place.rpartition(":")
    if colon and one not in choices:
        raise SettingError(f"{word!r} names no {kind.name} here; accepted: {', '.join(choices)}")
    if not _KEYS.fullmatch(key):
        accepted = f"KEY=VALUE or {kind.name.upper()}:KEY=VALUE"
        raise SettingError(f"{word!r} is not a setting; accepted: {accepted}")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        raise SettingError(f"{word!r} has no value; accepted: KEY=VALUE, as in YAML") from None
    keys = key.removeprefix(f"{kind.name}.").split(".")
    for part in reversed(keys):
        value = {part: value}
    asked = [one] if colon else list(choices)
    having = [label for label in asked if _has(choices[label].settings, keys)]
    for label in having or asked[:1]:
        choice = choices[label]
        try:
            settings = changed_settings(choice.settings, value, where=kind.name)
        except SettingError as error:
            raise SettingError(f"{label}: {error}") from None
        changes = (*choice.changes, f"{key}={text}")
        choices[label] = Choice(
            kind, label, name=choice.name, settings=settings, preset=choice.preset, changes=changes
        )


def _has(settings: Any, keys: Sequence[str]) -> bool:
    """Return whether settings have a setting of this path."""
    for key in keys:
        if not hasattr(settings, key):
            return False
        settings = getattr(settings, key)
    return True
