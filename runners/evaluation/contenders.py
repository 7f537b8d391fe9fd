"""The methods of an evaluation, with the settings and the labels under which they take part."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from chsel.errors import SettingError, require_choice, require_instance
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.method import Method
from chsel.problem.settings import build_settings, changed_settings, settings_mapping
from replay.comparing.choices import LABELS_HELP
from runners.evaluation.repeats import repeat_label, require_repeats

_LABEL = re.compile(r"(?P<name>\w+)(@(?P<preset>\w+))?(#(?P<mark>[\w+-]+))?")
_FILE_NAME = re.compile(r"[\w@#+-]{1,80}")
TAKEN = ("session",)
"""Labels that would be files of something else."""


@dataclass(frozen=True, eq=False)
class Contender:
    """A registered method with all of its settings.

    label: what the table calls it. draw: which of several with other random numbers it is.
    """

    label: str
    name: str
    preset: str
    settings: Mapping[str, Any]
    draw: int = 0

    def method(self) -> Method:
        """The method itself."""
        return build_method(self.name, self.settings)

    @property
    def config(self) -> dict[str, Any]:
        """As experiment.json has it."""
        content = {"name": self.name, "preset": self.preset, "settings": dict(self.settings)}
        return content | ({"draw": self.draw} if self.draw else {})


@dataclass(frozen=True)
class _Entry:
    """A contender as a configuration writes it down."""

    name: str
    label: str | None = None
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
    entries = [_entry(value) for value in _listed(methods)]
    labels = [entry.label or entry.name for entry in entries]
    for label in labels:
        if labels.count(label) > 1:
            raise SettingError(f"methods has {label} twice; accepted: {LABELS_HELP}")
        require_label(label)
    for key in settings:
        require_choice("settings of a method", key, dict.fromkeys([*METHODS, *labels]))
    return tuple(
        _contender(entry, label, settings, preset)
        for entry, label in zip(entries, labels, strict=True)
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


def require_label(label: str) -> None:
    """Raise SettingError for a label that cannot be the name of a file here."""
    if not _FILE_NAME.fullmatch(label) or label in TAKEN:
        raise SettingError(
            f"{label!r} is not a label; accepted: letters, digits and any of _ @ # + -, "
            f"other than {', '.join(TAKEN)}"
        )


def _listed(methods: Any) -> Sequence[Any]:
    if isinstance(methods, str):
        return METHODS if methods == "all" else [text.strip() for text in methods.split(",")]
    if isinstance(methods, Mapping):
        return [methods]
    if not isinstance(methods, list | tuple):
        raise SettingError(f"methods is {methods!r}; accepted: all, or a list of {LABELS_HELP}")
    return methods


def _entry(value: Any) -> _Entry:
    if isinstance(value, Mapping):
        return build_settings(_Entry, value, "methods")
    match = _LABEL.fullmatch(str(value))
    if match is None:
        raise SettingError(f"methods has {value!r}; accepted: {LABELS_HELP}")
    return _Entry(match["name"], str(value), match["preset"])


def _contender(entry: _Entry, label: str, settings: Mapping[str, Any], preset: str) -> Contender:
    preset = entry.preset or preset
    chosen = preset_settings(entry.name, preset)
    for key in dict.fromkeys([entry.name, label]):
        chosen = changed_settings(chosen, settings.get(key) or {}, f"settings.{key}")
    chosen = changed_settings(chosen, entry.settings or {}, f"methods: settings of {label}")
    method = build_method(entry.name, chosen)
    return Contender(label, entry.name, preset, settings_mapping(method.settings))
