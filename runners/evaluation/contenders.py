"""The methods and policies of an evaluation: settings, labels, and repeats of methods."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from chsel.errors import (
    SettingError,
    require_at_most,
    require_choice,
    require_instance,
    require_positive,
)
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.method import Method
from chsel.policies import POLICIES, build_policy, policy_settings
from chsel.policies.policy import Policy
from chsel.problem.settings import build_settings, changed_settings, settings_mapping
from chsel.problem.streams import StreamKey
from replay.comparing.choices import LABELS_HELP

MOST_REPEATS = 1000
_APART = 2**32  # between the seeds of two draws, so that these are no seeds of other sessions
_REPEAT = re.compile(r"(?P<label>.+)\+(?P<draw>[1-9]\d{0,2})")
_LABEL = re.compile(r"(?P<name>\w+)(@(?P<preset>\w+))?(#[\w+-]+)?")
_FILE_NAME = re.compile(r"[\w@#+-]{1,80}")
_SESSION = "session"  # a label that would be the name of another file
_POLICIES_HELP = f"NAME, NAME#MARK or {{name, label, settings}}; {', '.join(POLICIES)}"


@dataclass(frozen=True, eq=False)
class Contender:
    """A registered method with all of its settings."""

    label: str  # what the table calls it
    name: str
    preset: str
    settings: Mapping[str, Any]
    draw: int = 0  # which of several with other random numbers

    def method(self) -> Method:
        """The method itself."""
        return build_method(self.name, self.settings)

    @property
    def config(self) -> dict[str, Any]:
        """As experiment.json has it."""
        content = {"name": self.name, "preset": self.preset, "settings": dict(self.settings)}
        return content | ({"draw": self.draw} if self.draw else {})


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
class _Entry:
    """A contender as a configuration writes it down."""

    name: str
    label: str = ""
    preset: str | None = None
    settings: Any = None


def chosen_contenders(
    methods: Any, settings: Mapping[str, Any], preset: str
) -> tuple[Contender, ...]:
    """Contenders of a configuration's list, or of "all".

    An entry is a label as `replay compare` takes it, NAME, NAME@PRESET or NAME@PRESET#MARK, or a
    mapping with name and, where wanted, label, preset and settings. settings: changes by method or
    by label, for all entries that these fit; an entry's own come last. preset: where an entry has
    none. Raises SettingError for what does not exist, and for a label that is taken.
    """
    require_instance("settings", settings, Mapping, "a group of settings by method")
    entries = _entries("methods", methods, METHODS, LABELS_HELP)
    for key in settings:
        require_choice("settings of a method", key, dict.fromkeys([*METHODS, *entries]))
    return tuple(
        _contender(entry, label, settings, entry.preset or preset)
        for label, entry in entries.items()
    )


def chosen_policies(policies: Any, settings: Mapping[str, Any]) -> dict[str, PolicyContender]:
    """The policies of a configuration's list, or of "all", by label; none for None.

    settings: changes to those that every policy has by default; an entry's own come last. Raises
    SettingError for what does not exist, and for a label that is taken.
    """
    chosen: dict[str, PolicyContender] = {}
    if policies is None:
        return chosen
    for label, entry in _entries("policies", policies, POLICIES, _POLICIES_HELP).items():
        if entry.preset is not None:
            raise SettingError(f"policies has {label!r}; accepted: {_POLICIES_HELP}")
        values = changed_settings(policy_settings(entry.name), settings, "policy")
        values = changed_settings(values, entry.settings or {}, f"policies: settings of {label}")
        chosen[label] = PolicyContender(label, entry.name, settings_mapping(values))
    return chosen


def _entries(setting: str, value: Any, every: Iterable[str], accepted: str) -> dict[str, _Entry]:
    """The entries of a list of contenders by their labels."""
    if isinstance(value, str):
        value = list(every) if value == "all" else [text.strip() for text in value.split(",")]
    listed = [value] if isinstance(value, Mapping) else value
    if not isinstance(listed, list | tuple) or not listed:
        raise SettingError(f"{setting} is {value!r}; accepted: all, or a list of {accepted}")
    entries: dict[str, _Entry] = {}
    for one in listed:
        if isinstance(one, Mapping):
            entry = build_settings(_Entry, one, setting)
        else:
            match = _LABEL.fullmatch(str(one))
            if match is None:
                raise SettingError(f"{setting} has {one!r}; accepted: {accepted}")
            entry = _Entry(match["name"], str(one), match["preset"])
        label = entry.label or entry.name
        require_label(label)
        if label in entries:
            raise SettingError(f"{setting} has {label} twice; accepted: {accepted}")
        entries[label] = entry
    return entries


def _contender(entry: _Entry, label: str, settings: Mapping[str, Any], preset: str) -> Contender:
    chosen = preset_settings(entry.name, preset)
    for key in dict.fromkeys([entry.name, label]):
        chosen = changed_settings(chosen, settings.get(key) or {}, f"settings.{key}")
    chosen = changed_settings(chosen, entry.settings or {}, f"methods: settings of {label}")
    method = build_method(entry.name, chosen)
    return Contender(label, entry.name, preset, settings_mapping(method.settings))


def require_label(label: str) -> None:
    """Raise SettingError for a label that cannot be the name of a file here."""
    if not _FILE_NAME.fullmatch(label) or label == _SESSION:
        raise SettingError(
            f"{label!r} is not a label; accepted: letters, digits and any of _ @ # + -, "
            f"other than {_SESSION}"
        )


def drawn(contenders: Sequence[Contender], draws: int) -> tuple[Contender, ...]:
    """Every contender so many times, with other random numbers and a label for each.

    Raises SettingError for a number of draws that there cannot be, and for a label that is taken.
    """
    require_repeats(draws)
    every = tuple(
        replace(contender, label=repeat_label(contender.label, draw), draw=draw)
        for contender in contenders
        for draw in range(draws)
    )
    labels = [contender.label for contender in every]
    for label in labels:
        require_label(label)
        if labels.count(label) > 1:
            raise SettingError(
                f"methods has {label}, which draws={draws} makes, too; accepted: another label"
            )
    return every


def require_repeats(draws: int) -> None:
    """Raise SettingError for a number of draws that there cannot be."""
    require_positive("draws", draws)
    require_at_most("draws", draws, MOST_REPEATS)


def repeat_label(label: str, draw: int) -> str:
    """What tables call a draw: the first one as if there were no others, then LABEL+1, LABEL+2."""
    return f"{label}+{draw}" if draw else label


def repeat_of(label: str, labels: Collection[str]) -> tuple[str, int]:
    """The label without its draw, and the draw. labels: all that there are."""
    match = _REPEAT.fullmatch(label)
    if match is None or match["label"] not in labels:
        return label, 0
    return match["label"], int(match["draw"])


def repeat_seed(seed: int, draw: int) -> int:
    """The seed of all random streams of a draw, of a session with this seed."""
    return StreamKey(seed + _APART * draw, 0).seed
