"""The methods and policies of an evaluation: settings, labels, and draws of methods."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from chsel.errors import SettingError, require_choice, require_instance
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
_FILE_NAME = re.compile(r"(?!session$)[\w@#+-]{1,80}")  # session: the name of another file
_POLICIES_HELP = f"NAME, NAME#MARK or {{name, label, settings}}; {', '.join(POLICIES)}"


@dataclass(frozen=True, eq=False)
class Contender:
    """A registered method or policy; as an entry of a configuration it has changes of settings."""

    name: str
    label: str = ""  # what the table calls it
    preset: str | None = None  # of a method
    settings: Any = None  # all of them
    draw: int = 0  # of a method: which of several with other random numbers

    def method(self) -> Method:
        """Return the method itself."""
        return build_method(self.name, self.settings)

    def policy(self) -> Policy:
        """Return the policy itself."""
        return build_policy(self.name, self.settings)


def chosen_contenders(
    methods: Any, settings: Mapping[str, Any], *, preset: str, draws: int = 1
) -> dict[str, Contender]:
    """Return, by label, the contenders of a list, or of "all", each so many times.

    An entry is a label as `replay compare` takes it, NAME, NAME@PRESET or NAME@PRESET#MARK, or a
    mapping with name and, where wanted, label, preset and settings. settings: changes by method or
    by label, for all entries that these fit; an entry's own come last. preset: where an entry has
    none. Raise SettingError for what does not exist, and for a label that is taken.
    """
    require_instance("settings", settings, kind=Mapping, accepted="a group of settings by method")
    require_repeats(draws)
    entries = _entries("methods", methods, every=METHODS, accepted=LABELS_HELP)
    for key in settings:
        require_choice("settings of a method", key, accepted=dict.fromkeys([*METHODS, *entries]))
    chosen: dict[str, Contender] = {}
    for label, entry in entries.items():
        own_preset = entry.preset or preset
        values = preset_settings(entry.name, own_preset)
        for key in dict.fromkeys([entry.name, label]):
            values = changed_settings(values, settings.get(key) or {}, where=f"settings.{key}")
        values = changed_settings(
            values, entry.settings or {}, where=f"methods: settings of {label}"
        )
        made = settings_mapping(build_method(entry.name, values).settings)
        for draw in range(draws):
            name = repeat_label(label, draw)
            require_label(name)
            if name in chosen:
                raise SettingError(f"methods has {name} twice; accepted: {LABELS_HELP}")
            chosen[name] = Contender(entry.name, name, preset=own_preset, settings=made, draw=draw)
    return chosen


def chosen_policies(policies: Any, settings: Mapping[str, Any]) -> dict[str, Contender]:
    """Return the policies of a configuration's list, or of "all", by label; none for None.

    settings: changes to those that every policy has by default; an entry's own come last. Raises
    SettingError for what does not exist, and for a label that is taken.
    """
    chosen: dict[str, Contender] = {}
    if policies is None:
        return chosen
    for label, entry in _entries(
        "policies", policies, every=POLICIES, accepted=_POLICIES_HELP
    ).items():
        require_label(label)
        if entry.preset is not None:
            raise SettingError(f"policies has {label!r}; accepted: {_POLICIES_HELP}")
        values = changed_settings(policy_settings(entry.name), settings, where="policy")
        values = changed_settings(
            values, entry.settings or {}, where=f"policies: settings of {label}"
        )
        chosen[label] = Contender(entry.name, label, settings=settings_mapping(values))
    return chosen


def _entries(
    setting: str, value: Any, *, every: Iterable[str], accepted: str
) -> dict[str, Contender]:
    """Return the entries of a list of contenders by their labels."""
    if isinstance(value, str):
        value = list(every) if value == "all" else [text.strip() for text in value.split(",")]
    listed = [value] if isinstance(value, Mapping) else value
    if not isinstance(listed, list | tuple) or not listed:
        raise SettingError(f"{setting} is {value!r}; accepted: all, or a list of {accepted}")
    entries: dict[str, Contender] = {}
    for one in listed:
        if isinstance(one, Mapping):
            entry = build_settings(Contender, one, where=setting)
        elif match := _LABEL.fullmatch(str(one)):
            entry = Contender(match["name"], str(one), preset=match["preset"])
        else:
            raise SettingError(f"{setting} has {one!r}; accepted: {accepted}")
        label = entry.label or entry.name
        if label in entries:
            raise SettingError(f"{setting} has {label} twice; accepted: {accepted}")
        entries[label] = entry
    return entries


def require_label(label: str) -> None:
    """Raise SettingError for a label that cannot be the name of a file here."""
    if not _FILE_NAME.fullmatch(label):
        raise SettingError(
            f"{label!r} is not a label; accepted: letters, digits and any of _ @ # + -, other than "
            "session"
        )


def require_repeats(draws: int) -> None:
    """Raise SettingError for a number of draws that there cannot be."""
    if not 0 < draws <= MOST_REPEATS:
        raise SettingError(f"draws is {draws}; accepted: 1 to {MOST_REPEATS}")


def repeat_label(label: str, draw: int) -> str:
    """Return the label of a draw in tables: LABEL for the first one, then LABEL+1, LABEL+2."""
    return f"{label}+{draw}" if draw else label


def repeat_of(label: str, labels: Collection[str]) -> tuple[str, int]:
    """Return the label without its draw, and the draw. labels: all that there are."""
    match = _REPEAT.fullmatch(label)
    if match is None or match["label"] not in labels:
        return label, 0
    return match["label"], int(match["draw"])


def repeat_seed(seed: int, draw: int) -> int:
    """Return the seed of all random streams of a draw, of a session with this seed."""
    return StreamKey(seed + _APART * draw, 0).seed
