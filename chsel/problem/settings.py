"""Frozen settings from plain mappings and presets, with errors that name what is accepted.

The defaults of a settings class are the preset `default`. Its class variable `presets` has what
differs from them in the others: `paper`, as printed, and `reference`, as the paper's authors ran
it. docs/presets.md has all differences with their reasons.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Annotated, Any, TypeVar

from chsel.errors import (
    SettingError,
    quoted,
    require_at_most,
    require_between,
    require_choice,
    require_positive,
)

Settings = TypeVar("Settings")
Presets = Mapping[str, Mapping[str, Any]]
PRESETS = ("default", "paper", "reference")
Check = Callable[[str, Any], None]


class CheckedSettings:
    """Base of settings whose annotations say what their fields accept.

    A field `rate: Annotated[float, positive]` raises SettingError for other values; None passes
    where the type has it. A class that checks more, such as pairs of fields, extends __post_init__.
    """

    def __post_init__(self) -> None:
        for name, (optional, checks) in _checks_of(type(self)).items():  # type: ignore[arg-type]
            value = getattr(self, name)
            if not (optional and value is None):
                for check in checks:
                    check(name, value)


def positive(name: str, value: Any) -> None:
    """A finite number above 0."""
    require_positive(name, value)


def not_negative(name: str, value: Any) -> None:
    """A finite number of at least 0."""
    require_positive(name, value, zero=True)


def at_most(most: float) -> Check:
    """A number of at most `most`."""
    return partial(require_at_most, most=most)


def between(low: float, high: float) -> Check:
    """A length from `low` to `high`, metres."""
    return partial(require_between, low=low, high=high)


def one_of(*accepted: str) -> Check:
    """One of the accepted names."""
    return partial(require_choice, accepted=accepted)


@cache
def _checks_of(cls: type) -> dict[str, tuple[bool, tuple[Check, ...]]]:
    """Whether a field may be None, and its checks, by name."""
    return {
        name: (type(None) in typing.get_args(hint.__origin__), hint.__metadata__)
        for name, hint in typing.get_type_hints(cls, include_extras=True).items()
        if typing.get_origin(hint) is Annotated
    }


@cache
def _hints_of(cls: type) -> dict[str, Any]:
    """The types of fields, by name."""
    return typing.get_type_hints(cls)


def build_settings(cls: type[Settings], mapping: Mapping[str, Any], where: str) -> Settings:
    """Make the dataclass `cls` from a plain mapping; nested mappings make nested dataclasses.

    `where` is the name of the mapping in messages ("method.cost"). What the mapping leaves out has
    its default. Raises SettingError for names that `cls` does not have, for names that are missing,
    and for values of another type.
    """
    return _built(cls, mapping, where, None)


def changed_settings(settings: Settings, changes: Mapping[str, Any], where: str) -> Settings:
    """`settings` with changes laid over them, group by group; nothing else changes.

    Raises SettingError as `build_settings` does.
    """
    return _built(type(settings), changes, where, settings)


def in_preset(settings: Settings, preset: str) -> Settings:
    """Settings of the preset `default` as another one of `PRESETS` has them.

    Each group of settings changes as its own class says, then what `presets` of this class names.
    A class without `presets` is the same in all of them, with its groups.
    """
    require_choice("preset", preset, PRESETS)
    presets = getattr(settings, "presets", None)
    if presets is None:
        return settings
    values = vars(settings).items()
    groups = {n: in_preset(v, preset) for n, v in values if dataclasses.is_dataclass(v)}
    settings = dataclasses.replace(settings, **groups)  # type: ignore[type-var]
    return changed_settings(settings, presets.get(preset, {}), f"preset {preset}")


def settings_mapping(settings: Any) -> dict[str, Any]:
    """The plain nested mapping that `build_settings` turns back into equal settings."""
    return dataclasses.asdict(settings)


def _built(
    cls: type[Settings], mapping: Mapping[str, Any], where: str, base: Settings | None
) -> Settings:
    """`base` with the values of a mapping; without a base, an instance of `cls` of these."""
    if not isinstance(mapping, Mapping):
        raise SettingError(f"{where} is {quoted(mapping)}; accepted: a group of settings")
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in mapping:
        if name not in fields:
            raise SettingError(_unknown(where, str(name), list(fields)))
    kind: Any = cls
    hints = _hints_of(kind)
    if base is None:
        before = {name: _default(field) for name, field in fields.items()}
    else:
        before = {name: getattr(base, name) for name in fields}
    values = before | {
        name: _convert(hints[name], value, f"{where}.{name}", before[name])
        for name, value in mapping.items()
    }
    missing = [name for name, value in values.items() if value is dataclasses.MISSING]
    if missing:
        raise SettingError(f"{where} lacks {', '.join(missing)}")
    try:
        return cls(**values)
    except SettingError as error:
        raise SettingError(f"{where}: {error}") from None


def _default(field: dataclasses.Field[Any]) -> Any:
    """The default of a field, MISSING if it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _unknown(where: str, name: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(name, accepted, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{where}.{name} does not exist; {hint}accepted: {', '.join(sorted(accepted))}"


def _convert(hint: Any, value: Any, where: str, before: Any = None) -> Any:
    """`value` as the annotated type `hint`, or SettingError; a group is laid over `before`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        inner = [argument for argument in arguments if argument is not type(None)]
        return _convert(inner[0], value, where, before)
    if dataclasses.is_dataclass(hint):
        base = before if isinstance(before, hint) else None  # type: ignore[arg-type]
        return _built(typing.cast(type, hint), value, where, base)
    if origin is tuple:
        return _convert_tuple(arguments, value, where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any or (isinstance(value, hint) and not (hint is int and isinstance(value, bool))):
        return value
    raise SettingError(f"{where} is {quoted(value)}; accepted: {_name(hint)}")


def _convert_tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise SettingError(f"{where} is {quoted(value)}; accepted: a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise SettingError(f"{where} has {len(value)} entries; accepted: {len(arguments)}")
    pairs = zip(arguments, value, strict=True)
    return tuple(_convert(hint, item, f"{where}[{i}]") for i, (hint, item) in enumerate(pairs))


def _name(hint: Any) -> str:
    names = {int: "an integer", float: "a number", str: "a text", bool: "true or false"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))
