"""Frozen settings from plain mappings, with errors that name what would be accepted."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from chsel.errors import SettingError, quoted

Settings = TypeVar("Settings")


def build_settings(cls: type[Settings], mapping: Mapping[str, Any], where: str) -> Settings:
    """Make the dataclass `cls` from a plain mapping; nested mappings make nested dataclasses.

    `where` is the name of the mapping in messages ("method.cost"). Raises SettingError for
    names that `cls` does not have, for names that are missing, and for values of another type.
    """
    if not isinstance(mapping, Mapping):
        raise SettingError(f"{where} is {quoted(mapping)}; accepted: a group of settings")
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in mapping:
        if name not in fields:
            raise SettingError(_unknown(where, str(name), list(fields)))
    hints = typing.get_type_hints(cls)
    values = {
        name: _convert(hints[name], value, f"{where}.{name}") for name, value in mapping.items()
    }
    missing = [name for name, field in fields.items() if name not in values and _required(field)]
    if missing:
        raise SettingError(f"{where} lacks {', '.join(missing)}")
    try:
        return cls(**values)
    except SettingError as error:
        raise SettingError(f"{where}: {error}") from None


def settings_mapping(settings: Any) -> dict[str, Any]:
    """The plain nested mapping that `build_settings` turns back into equal settings."""
    return dataclasses.asdict(settings)


def _required(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _unknown(where: str, name: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(name, accepted, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{where}.{name} does not exist; {hint}accepted: {', '.join(sorted(accepted))}"


def _convert(hint: Any, value: Any, where: str) -> Any:
    """`value` as the annotated type `hint`, or SettingError."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        inner = [argument for argument in arguments if argument is not type(None)]
        return _convert(inner[0], value, where)
    if dataclasses.is_dataclass(hint):
        return build_settings(typing.cast(type, hint), value, where)
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
