"""Frozen settings from plain mappings and presets, and what users choose by name and settings.

Errors name what is accepted. The defaults of a settings class are the preset `default`. Its class
variable `presets` has what differs from them in the others: `paper`, as printed, and `reference`,
as the paper's authors ran it. docs/presets.md has all differences with their reasons.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import cache, cached_property, partial
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any, Generic, TypeVar

from chsel.errors import (
    SettingError,
    quoted,
    require_at_most,
    require_between,
    require_choice,
    require_instance,
    require_positive,
)

Settings = TypeVar("Settings")
Presets = Mapping[str, Mapping[str, Any]]
PRESETS = ("default", "paper", "reference")
Check = Callable[[str, Any], None]
Made = TypeVar("Made")
Entry = tuple[Callable[[Any], Made], Any]
"""What makes a choice of its settings, and its settings by default."""

_hints: Callable[[Any], dict[str, Any]] = cache(partial(typing.get_type_hints, include_extras=True))
_KINDS = {int: "an integer", float: "a number", str: "a text", bool: "true or false"}

positive = require_positive
not_negative = partial(require_positive, zero=True)


def at_most(most: float) -> Check:
    """Return a number of at most `most`."""
    return partial(require_at_most, most=most)


def between(low: float, high: float) -> Check:
    """Return a length from `low` to `high`, metres."""
    return partial(require_between, low=low, high=high)


def one_of(*accepted: str) -> Check:
    """Return one of the accepted names."""
    return partial(require_choice, accepted=accepted)


class CheckedSettings:
    """Base of settings whose annotations say what their fields accept.

    A field `rate: Annotated[float, positive]` raises SettingError for other values; None passes
    where the type has it, within Annotated or beside it. A class that checks more, such as pairs of
    fields, extends __post_init__.
    """

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            for checked in _annotated(hint):
                if value is not None or type(None) not in (
                    *typing.get_args(hint),
                    *typing.get_args(checked.__origin__),
                ):
                    for check in checked.__metadata__:
                        check(name, value)


def _annotated(hint: Any) -> list[Any]:
    """Return the hint, or those of a union, that are Annotated."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    hints = typing.get_args(hint) if union else (hint,)
    return [each for each in hints if typing.get_origin(each) is Annotated]


def build_settings(
    cls: type[Settings], mapping: Mapping[str, Any], *, where: str, base: Settings | None = None
) -> Settings:
    """Make the dataclass `cls` from a plain mapping; nested mappings make nested dataclasses.

    `where` is the name of the mapping in messages ("method.cost"). What the mapping leaves out is
    as in `base`, or has its default. Raises SettingError for names that `cls` does not have, for
    names that are missing, and for values of another type.
    """
    if not isinstance(mapping, Mapping):
        raise SettingError(f"{where} is {quoted(mapping)}; accepted: a group of settings")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if base is not None:
            values[field.name] = getattr(base, field.name)
        else:
            make = field.default_factory
            values[field.name] = field.default if make is MISSING else make()
    for name in mapping:
        if name not in values:
            close = difflib.get_close_matches(str(name), values, n=1)
            meant = f"did you mean {close[0]}? " if close else ""
            raise SettingError(
                f"{where}.{name} does not exist; {meant}accepted: {', '.join(sorted(values))}"
            )
    for name, value in mapping.items():
        values[name] = _convert(
            _hints(cls)[name], value, where=f"{where}.{name}", before=values[name]
        )
    missing = [name for name, value in values.items() if value is MISSING]
    if missing:
        raise SettingError(f"{where} lacks {', '.join(missing)}")
    try:
        return cls(**values)
    except SettingError as error:
        raise SettingError(f"{where}: {error}") from None


def changed_settings(settings: Settings, changes: Mapping[str, Any], *, where: str) -> Settings:
    """Return `settings` with changes laid over them, group by group; nothing else changes.

    Raises SettingError as `build_settings` does.
    """
    return build_settings(type(settings), changes, where=where, base=settings)


def settings_mapping(settings: Any) -> dict[str, Any]:
    """Return the plain nested mapping that `build_settings` turns back into equal settings."""
    return dataclasses.asdict(settings)


def _convert(hint: Any, value: Any, *, where: str, before: Any = None) -> Any:
    """Return `value` as the annotated type `hint`, or SettingError; groups lie over `before`."""
    if typing.get_origin(hint) is Annotated:
        hint = hint.__origin__
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        inner = [argument for argument in arguments if argument is not type(None)]
        return _convert(inner[0], value, where=where, before=before)
    if dataclasses.is_dataclass(hint):
        base = before if isinstance(before, hint) else None  # type: ignore[arg-type]
        return build_settings(typing.cast(type, hint), value, where=where, base=base)
    if origin is tuple:
        return _convert_tuple(arguments, value, where=where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any or (isinstance(value, hint) and not (hint is int and isinstance(value, bool))):
        return value
    accepted = _KINDS.get(hint, getattr(hint, "__name__", str(hint)))
    raise SettingError(f"{where} is {quoted(value)}; accepted: {accepted}")


def _convert_tuple(arguments: tuple[Any, ...], value: Any, *, where: str) -> tuple[Any, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise SettingError(f"{where} is {quoted(value)}; accepted: a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise SettingError(f"{where} has {len(value)} entries; accepted: {len(arguments)}")
    pairs = zip(arguments, value, strict=True)
    return tuple(
        _convert(hint, item, where=f"{where}[{i}]") for i, (hint, item) in enumerate(pairs)
    )


def in_preset(settings: Settings, preset: str) -> Settings:
    """Return settings of the preset `default` as another one of `PRESETS` has them.

    Each group of settings changes as its own class says, then what `presets` of this class names.
    A class without `presets` is the same in all of them, with its groups.
    """
    require_choice("preset", preset, accepted=PRESETS)
    presets = getattr(settings, "presets", None)
    if presets is None:
        return settings
    values = vars(settings).items()
    groups = {n: in_preset(v, preset) for n, v in values if dataclasses.is_dataclass(v)}
    settings = dataclasses.replace(settings, **groups)  # type: ignore[type-var]
    return changed_settings(settings, presets.get(preset, {}), where=f"preset {preset}")


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
        """Names of the choices: ours in their order, then those of installed packages."""
        return (*self.ours, *(name for name in sorted(self._offers) if name not in self.ours))

    def entry(self, name: str) -> Entry[Made]:
        """Return the class of a choice, and its settings by default.

        Raises SettingError for a name that does not exist, and for a choice of an installed package
        that cannot be imported, is not of this kind, or has two packages.
        """
        require_choice(self.kind, name, accepted=self.names)
        if name not in self._entries:
            self._entries[name] = self._load(name)
        return self._entries[name]

    def settings(self, name: str, preset: str = "default") -> Any:
        """Return the settings of a choice by name in a preset of PRESETS; else SettingError."""
        make, default = self.entry(name)
        require_choice("preset", preset, accepted=PRESETS)
        in_own_preset = getattr(make, "preset", None)
        return in_own_preset(preset) if in_own_preset else in_preset(default, preset)

    def build(self, name: str, settings: Any = None) -> Made:
        """Return a choice, such as a method or a policy, by name.

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
            settings = changed_settings(default, settings, where=self.kind)
        require_instance(
            "settings", settings, kind=kind, accepted=f"a mapping, or a {kind.__name__}"
        )
        return self.entry(name)[0](settings)

    def _load(self, name: str) -> Entry[Made]:
        packages = self._packages(name)
        if len(packages) > 1:
            raise SettingError(
                f"{self.kind} {name} is of {' and '.join(packages)}; accepted: one of them"
            )
        who = f"{self.kind} {name} of package {packages[0]}"
        try:
            offered = self._offers[name][0].load()
            default = offered()
        except Exception as error:  # whatever somebody else's code raises
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise SettingError(
                f"{who} cannot be loaded: {reason}; accepted: a class as in {self.page}"
            ) from error
        settings = getattr(default, "settings", None)
        lacks: str | None = f"settings {settings!r}; accepted: a frozen dataclass"
        if dataclasses.is_dataclass(settings):
            lacks = self.lacks(default)
        if lacks:
            raise SettingError(f"{who} has {lacks}; see {self.page}")
        return offered, settings

    def _packages(self, name: str) -> list[str]:
        """Return the installed packages that offer a choice of that name."""
        return sorted(point.dist.name if point.dist else "unknown" for point in self._offers[name])

    @cached_property
    def _entries(self) -> dict[str, Entry[Made]]:
        """Ours, and those of packages that were asked for."""
        return dict(self.ours)

    @cached_property
    def _offers(self) -> dict[str, list[EntryPoint]]:
        """Entry points of the group by their names."""
        offers: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self.group):
            offers.setdefault(point.name, []).append(point)
        return offers
