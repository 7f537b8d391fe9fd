"""What users choose by name and change by settings: ours, and what installed packages offer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from chsel.errors import SettingError, require_choice, require_instance
from chsel.problem.settings import PRESETS, changed_settings, in_preset

Made = TypeVar("Made")
Entry = tuple[Callable[[Any], Made], Any]
"""What makes a choice of its settings, and its settings by default."""


@dataclass(eq=False)
class NamedChoices(Generic[Made]):
    """The choices of one kind by name."""

    kind: str  # what messages call one
    group: str  # of entry points, by which packages offer theirs
    page: str  # of docs/, on writing one
    ours: Mapping[str, Entry[Made]]  # those of this package
    lacks: Callable[[Any], str | None]  # what an object lacks to be one and what is accepted

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names: ours in their order, then those of installed packages."""
        return (*self.ours, *(name for name in sorted(self._offers) if name not in self.ours))

    def entry(self, name: str) -> Entry[Made]:
        """What makes a choice of its settings, and its settings by default.

        Raises SettingError for a name that does not exist, and for a choice of an installed package
        that cannot be imported, is not of this kind, or has two packages.
        """
        require_choice(self.kind, name, self.names)
        if name not in self._entries:
            self._entries[name] = self._load(name)
        return self._entries[name]

    def settings(self, name: str, preset: str = "default") -> Any:
        """The settings of a choice by name in a preset, one of PRESETS; SettingError if none is."""
        make, default = self.entry(name)
        require_choice("preset", preset, PRESETS)
        in_own_preset = getattr(make, "preset", None)
        return in_own_preset(preset) if in_own_preset else in_preset(default, preset)

    def build(self, name: str, settings: Any = None) -> Made:
        """A choice, such as a method or a policy, by name.

        settings: its settings, or a mapping of changes to those of the preset `default`. Raises
        SettingError for names and values that do not exist, and for a name of ours that an
        installed package offers, too.
        """
        default = self.settings(name)
        if name in self.ours and name in self._offers:
            also = f"{self.kind} {name} is of package {self._packages(name)[0]}, too"
            raise SettingError(f"{also}; accepted: one of them")
        kind = type(default)
        if settings is None:
            settings = default
        elif isinstance(settings, Mapping):
            settings = changed_settings(default, settings, self.kind)
        require_instance("settings", settings, kind, f"a mapping, or a {kind.__name__}")
        return self.entry(name)[0](settings)

    def _load(self, name: str) -> Entry[Made]:
        point, *others = self._offers[name]
        package = self._packages(name)
        if others:
            raise SettingError(
                f"{self.kind} {name} is of {' and '.join(package)}; accepted: one of them"
            )
        who = f"{self.kind} {name} of package {package[0]}"
        try:
            offered = point.load()
            default = offered()
        except Exception as error:  # whatever somebody else's code raises
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise SettingError(
                f"{who} cannot be loaded: {reason}; accepted: a class as in {self.page}"
            ) from error
        settings = getattr(default, "settings", None)
        if not dataclasses.is_dataclass(settings):
            lacks: str | None = f"settings {settings!r}; accepted: a frozen dataclass"
        else:
            lacks = self.lacks(default)
        if lacks:
            raise SettingError(f"{who} has {lacks}; see {self.page}")
        return offered, settings

    def _packages(self, name: str) -> list[str]:
        """The installed packages that offer a choice of that name."""
        return sorted(point.dist.name if point.dist else "unknown" for point in self._offers[name])

    @cached_property
    def _entries(self) -> dict[str, Entry[Made]]:
        """Ours, and those of packages that were asked for."""
        return dict(self.ours)

    @cached_property
    def _offers(self) -> dict[str, list[EntryPoint]]:
        """All entry points of the group, by their names."""
        offers: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self.group):
            offers.setdefault(point.name, []).append(point)
        return offers
