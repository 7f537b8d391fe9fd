"""Methods of other packages: an entry point of the group `chsel.methods` names each, and its class.

Names are looked up among installed packages alone; no file that is read names what is imported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from chsel.errors import SettingError
from chsel.methods.method import Method
from chsel.problem.warm_start import OnlineSettings

GROUP = "chsel.methods"
_IMPLEMENTED = "docs/writing_a_method.md"


def installed_names() -> tuple[str, ...]:
    """The names that installed packages give to methods."""
    return tuple(sorted(_offers()))


def offering_packages(name: str) -> tuple[str, ...]:
    """The packages that offer a method of that name."""
    return tuple(point.dist.name if point.dist else "unknown" for point in _offers().get(name, ()))


@cache
def installed_method(name: str) -> tuple[Callable[[Any], Method], Any]:
    """What makes an installed method of its settings, and its settings by default.

    Raises SettingError for one that cannot be imported, is no method, or is of two packages.
    """
    point, *others = _offers()[name]
    package = offering_packages(name)
    if others:
        raise SettingError(f"method {name} is of {' and '.join(package)}; accepted: one of them")
    who = f"method {name} of package {package[0]}"
    try:
        offered = point.load()
        default = offered()
    except Exception as error:  # whatever somebody else's code raises
        told = f"{type(error).__name__}: {error}"
        raise SettingError(
            f"{who} cannot be loaded: {told}; accepted: a class as in {_IMPLEMENTED}"
        ) from error
    if lacks := _lacks(default):
        raise SettingError(f"{who} has {lacks}; see {_IMPLEMENTED}")
    return offered, default.settings


def _lacks(method: Any) -> str | None:
    """What an object lacks to be a method, and what is accepted."""
    settings = getattr(method, "settings", None)
    if not dataclasses.is_dataclass(settings):
        return f"settings {settings!r}; accepted: a frozen dataclass"
    if not isinstance(getattr(method, "online", None), OnlineSettings):
        return "no `online`; accepted: a property that returns OnlineSettings"
    if not callable(getattr(method, "register", None)):
        return "no `register`; accepted: register(problem, observer=None)"
    return None


@cache
def _offers() -> dict[str, list[EntryPoint]]:
    """All entry points of the group, by their names."""
    offers: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=GROUP):
        offers.setdefault(point.name, []).append(point)
    return offers
