"""The registration methods by name: ours, and those of installed packages."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from chsel.errors import SettingError, require_choice, require_instance
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.chsel import Chsel, ChselSettings
from chsel.methods.cvo import Cvo, CvoSettings
from chsel.methods.gradient_descent import GradientDescent, GradientDescentSettings
from chsel.methods.icp import Icp, IcpSettings
from chsel.methods.medial_constraint import (
    MedialConstraint,
    MedialConstraintCmaMe,
    MedialConstraintCmaMeSettings,
    MedialConstraintSettings,
)
from chsel.methods.method import Method
from chsel.methods.svgd import Svgd, SvgdSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.settings import PRESETS, changed_settings, in_preset
from chsel.problem.trust import SENSOR_NOISE, has_pose, trust_in

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

    Raises SettingError for one that cannot be imported, is not a method, or has two packages.
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
        reason = f"{type(error).__name__}: {error}"
        raise SettingError(
            f"{who} cannot be loaded: {reason}; accepted: a class as in {_IMPLEMENTED}"
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


_OURS: dict[str, tuple[Callable[[Any], Method], Any]] = {
    "chsel": (Chsel, ChselSettings()),
    "chsel_cma_me": (Chsel, ChselSettings(search="cma_me")),
    "gradient_descent": (GradientDescent, GradientDescentSettings()),
    "icp": (Icp, IcpSettings()),
    "svgd": (Svgd, SvgdSettings()),
    "cvo": (Cvo, CvoSettings()),
    "cvo_no_free_space": (Cvo, CvoSettings(free_space=False)),
    "medial_constraint": (MedialConstraint, MedialConstraintSettings()),
    "medial_constraint_cma_me": (MedialConstraintCmaMe, MedialConstraintCmaMeSettings()),
    "anchored": (Anchored, AnchoredSettings()),
}
OURS = tuple(_OURS)
METHODS = (*OURS, *(name for name in installed_names() if name not in OURS))


def preset_settings(name: str, preset: str = "default") -> Any:
    """The settings of a method by name in a preset, one of PRESETS."""
    make, default = _entry(name)
    require_choice("preset", preset, PRESETS)
    own = getattr(make, "preset", None)  # of an installed method
    return own(preset) if own else in_preset(default, preset)


def build_method(name: str, settings: Any = None) -> Method:
    """A method by name.

    settings: its settings, or a mapping of changes to those of the preset `default`. Raises
    SettingError for names and values that do not exist, and for a name of ours that an installed
    package gives to a method, too.
    """
    make, _ = _entry(name)
    if name in OURS and (offering := offering_packages(name)):
        raise SettingError(f"method {name} is of package {offering[0]}, too; accepted: one of them")
    default = preset_settings(name)
    kind = type(default)
    if settings is None:
        settings = default
    elif isinstance(settings, Mapping):
        settings = changed_settings(default, settings, "method")
    require_instance("settings", settings, kind, f"a mapping, or a {kind.__name__}")
    return make(settings)


def noise_of(method: Method) -> float | None:
    """The noise of known points by a method's settings, metres; None if it has no such setting."""
    settings = getattr(method, "settings", None)
    return settings.noise if isinstance(settings, AnchoredSettings) else None


def trust_by(method: Method, problem: RegistrationProblem, hypotheses: Hypotheses) -> Trust | None:
    """How far to trust what a method found, by the noise in its settings; None without a pose."""
    if not has_pose(hypotheses):
        return None
    return trust_in(problem, hypotheses, noise_of(method) or SENSOR_NOISE)


def _entry(name: str) -> tuple[Callable[[Any], Method], Any]:
    """What makes a method of its settings, and its settings by default."""
    require_choice("method", name, METHODS)
    return _OURS[name] if name in OURS else installed_method(name)
