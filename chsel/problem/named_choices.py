"""What users choose by name and change by settings: ours, and what installed packages offer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from chsel.errors import SettingError, require_choice, require_instance
from chsel.problem.settings import changed_settings

Made = TypeVar("Made")
Entry = tuple[Callable[[Any], Made], Any]
"""What makes a choice of its settings, and its settings by default."""


class NamedChoices(Generic[Made]):
    """The choices of one kind by name.

    kind: what messages call one. group: of entry points, by which packages offer theirs. page: of
    docs/, on writing one. ours: those of this package. lacks: what an object lacks to be one and
    what is accepted, or None.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        page: str,
        ours: Mapping[str, Entry[Made]],
        lacks: Callable[[Any], str | None],
    ) -> None:
        self._kind, self._group, self._page = kind, group, page
        self._ours, self._lacks = ours, lacks
        self._loaded: dict[str, Entry[Made]] = {}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names: ours in their order, then those of installed packages."""
        return (*self._ours, *(name for name in sorted(self._offers) if name not in self._ours))

    def packages(self, name: str) -> tuple[str, ...]:
        """The installed packages that offer a choice of that name."""
        points = self._offers.get(name, ())
        return tuple(sorted(point.dist.name if point.dist else "unknown" for point in points))

    def entry(self, name: str) -> Entry[Made]:
        """What makes a choice of its settings, and its settings by default.

        Raises SettingError for a name that does not exist, and for a choice of an installed package
        that cannot be imported, is not of this kind, or has two packages.
        """
        require_choice(self._kind, name, self.names)
        if name in self._ours:
            return self._ours[name]
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def build(self, name: str, settings: Any, default: Any) -> Made:
        """A choice by name, of settings, or a mapping of changes to those by default.

        Raises SettingError for names and values that do not exist, and for a name of ours that an
        installed package offers, too.
        """
        make, _ = self.entry(name)
        if name in self._ours and (offering := self.packages(name)):
            raise SettingError(
                f"{self._kind} {name} is of package {offering[0]}, too; accepted: one of them"
            )
        kind = type(default)
        if settings is None:
            settings = default
        elif isinstance(settings, Mapping):
            settings = changed_settings(default, settings, self._kind)
        require_instance("settings", settings, kind, f"a mapping, or a {kind.__name__}")
        return make(settings)

    def _load(self, name: str) -> Entry[Made]:
        point, *others = self._offers[name]
        package = self.packages(name)
        if others:
            raise SettingError(
                f"{self._kind} {name} is of {' and '.join(package)}; accepted: one of them"
            )
        who = f"{self._kind} {name} of package {package[0]}"
        try:
            offered = point.load()
            default = offered()
        except Exception as error:  # whatever somebody else's code raises
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise SettingError(
                f"{who} cannot be loaded: {reason}; accepted: a class as in {self._page}"
            ) from error
        settings = getattr(default, "settings", None)
        if not dataclasses.is_dataclass(settings):
            lacks: str | None = f"settings {settings!r}; accepted: a frozen dataclass"
        else:
            lacks = self._lacks(default)
        if lacks:
            raise SettingError(f"{who} has {lacks}; see {self._page}")
        return offered, settings

    @cached_property
    def _offers(self) -> dict[str, list[EntryPoint]]:
        """All entry points of the group, by their names."""
        offers: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self._group):
            offers.setdefault(point.name, []).append(point)
        return offers
