"""The methods of a comparison: their labels, and the changes that each of them takes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from chsel.errors import RecordingError, SettingError, require_choice
from chsel.methods import METHODS
from chsel.problem.settings import PRESETS
from replay.mcap.reader import Recording
from replay.registration import NamedMethod, other_method, recorded_method

METHODS_HELP = "NAME, NAME@PRESET, NAME#MARK or NAME@PRESET#MARK; the mark tells equal ones apart"
_LABEL = re.compile(r"(?P<name>\w+)(@(?P<preset>\w+))?(#(?P<mark>[\w.+-]+))?")


@dataclass(frozen=True, eq=False)
class Contender:
    """A method that takes part, with the changes that apply to it.

    as_recorded: whether method and settings are those of the recording.
    """

    label: str
    named: NamedMethod
    changes: tuple[str, ...]
    as_recorded: bool


def contenders(
    recording: Recording, labels: Sequence[str], changes: Sequence[str] = ()
) -> tuple[Contender, ...]:
    """Methods by their labels, such as "chsel", "chsel@paper" or "chsel#small".

    Without a preset, settings are chosen as `other_method` does: those of the recording for its
    method. A change "KEY=VALUE" applies to every method that has the setting, "LABEL:KEY=VALUE" to
    one. Raises SettingError for a label or change that does not exist, or fits no method.
    """
    if not labels:
        raise SettingError(f"no method is named; accepted: {', '.join(METHODS)}")
    for label in labels:
        if labels.count(label) > 1:
            raise SettingError(f"{label} is named twice; accepted: {METHODS_HELP}")
    settings = {label: _base(recording, label).settings for label in labels}
    chosen = changes_by_label(labels, changes, settings, "method")
    return tuple(_contender(recording, label, tuple(texts)) for label, texts in chosen.items())


def changes_by_label(
    labels: Sequence[str],
    changes: Sequence[str],
    settings: Mapping[str, Mapping[str, Any]],
    kind: str,
) -> dict[str, list[str]]:
    """The changes KEY=VALUE that each label takes: of all labels, or of the one they name.

    settings: of each label. kind: "method" or "policy". Raises SettingError for a change that
    fits none.
    """
    chosen: dict[str, list[str]] = {label: [] for label in labels}
    for change in changes:
        one, key, text = _parted(change, labels, kind)
        asked = labels if one is None else [one]
        having = [label for label in asked if _has(settings[label], key, kind)]
        if not having:
            raise SettingError(_unknown(key, {label: settings[label] for label in asked}, kind))
        for label in having:
            chosen[label].append(text)
    return chosen


def recorded_or_none(recording: Recording) -> NamedMethod | None:
    """The method of a recording, if it has one that exists here."""
    try:
        return recorded_method(recording)
    except RecordingError:
        return None


def _contender(recording: Recording, label: str, changes: tuple[str, ...]) -> Contender:
    name, preset = _name_and_preset(label)
    try:
        named = other_method(recording, name, [*preset, *changes])
    except SettingError as error:
        raise SettingError(f"{label}: {error}") from None
    recorded = recorded_or_none(recording)
    same = recorded is not None and named.config == recorded.config
    return Contender(label, named, changes, same)


def _base(recording: Recording, label: str) -> NamedMethod:
    """The method of a label before any change."""
    name, preset = _name_and_preset(label)
    return other_method(recording, name, preset)


def _name_and_preset(label: str) -> tuple[str, list[str]]:
    """The method of a label, and its preset as a change."""
    match = _LABEL.fullmatch(label)
    if match is None:
        raise SettingError(f"{label!r} is not a method; accepted: {METHODS_HELP}")
    require_choice("method", match["name"], METHODS)
    if match["preset"] is None:
        return match["name"], []
    require_choice("preset", match["preset"], PRESETS)
    return match["name"], [f"preset={match['preset']}"]


def _parted(change: str, labels: Sequence[str], kind: str) -> tuple[str | None, str, str]:
    """The label of a change, None for all; its key; and the change without the label."""
    key, sign, _ = change.partition("=")
    label, colon, inner = key.rpartition(":")
    if not sign or not (inner if colon else key):
        accepted = f"KEY=VALUE or {kind.upper()}:KEY=VALUE"
        raise SettingError(f"{change!r} is not a setting; accepted: {accepted}")
    if not colon:
        return None, key, change
    if label not in labels:
        raise SettingError(f"{change!r} names no {kind} here; accepted: {', '.join(labels)}")
    return label, inner, change[len(label) + 1 :]


def _unknown(key: str, settings: Mapping[str, Mapping[str, Any]], kind: str) -> str:
    """That no label has a setting, and which it may have been meant to be."""
    labels = ", ".join(settings)
    paths = sorted({path for each in settings.values() for path in _paths("", each)})
    close = difflib.get_close_matches(key.removeprefix(f"{kind}."), paths, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    groups = dict.fromkeys(path.split(".")[0] for path in paths)
    return f"{key} does not exist in {labels}; {hint}accepted: {', '.join(groups)}"


def _paths(path: str, settings: Any) -> Iterator[str]:
    """All settings that are no groups, with the groups that they are in."""
    if isinstance(settings, Mapping):
        for name, inner in settings.items():
            yield from _paths(f"{path}.{name}" if path else name, inner)
    else:
        yield path


def _has(settings: Mapping[str, Any], key: str, kind: str) -> bool:
    """Whether there is such a setting, as `other_method` finds it."""
    if key == "preset" and kind == "method":
        return True
    inner: Any = settings
    for name in key.removeprefix(f"{kind}.").split("."):
        if not isinstance(inner, Mapping) or name not in inner:
            return False
        inner = inner[name]
    return True
