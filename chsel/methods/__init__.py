"""The registration methods, by name: ours, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from chsel import presets
from chsel.errors import SettingError, require_choice, require_instance
from chsel.methods.anchored.anchored import Anchored, AnchoredSettings, preset_anchored
from chsel.methods.chsel import Chsel, ChselSettings
from chsel.methods.cvo.cvo import Cvo, preset_cvo, preset_cvo_no_free_space
from chsel.methods.gradient_descent import GradientDescent, GradientDescentSettings
from chsel.methods.icp import Icp, preset_icp
from chsel.methods.installed import installed_method, installed_names, offering_packages
from chsel.methods.medial_constraint.medial_constraint import (
    MedialConstraint,
    MedialConstraintCmaMe,
    preset_medial_constraint,
    preset_medial_constraint_cma_me,
)
from chsel.methods.method import Method
from chsel.methods.svgd import Svgd, preset_svgd
from chsel.problem.settings import build_settings


def _chsel(preset: str) -> ChselSettings:
    return ChselSettings(
        cost=presets.COST[preset],
        descent=presets.DESCENT[preset],
        archive=presets.ARCHIVE[preset],
        emitter=presets.EMITTER[preset],
        output=presets.OUTPUT[preset],
        online=presets.ONLINE[preset],
        starts=presets.STARTS[preset],
    )


def _chsel_cma_me(preset: str) -> ChselSettings:
    return replace(_chsel(preset), search="cma_me")


def _gradient_descent(preset: str) -> GradientDescentSettings:
    return GradientDescentSettings(
        cost=presets.COST[preset], descent=presets.DESCENT[preset], online=presets.ONLINE[preset]
    )


_OURS: dict[str, tuple[Callable[[Any], Method], Callable[[str], Any]]] = {
    "chsel": (Chsel, _chsel),
    "chsel_cma_me": (Chsel, _chsel_cma_me),
    "gradient_descent": (GradientDescent, _gradient_descent),
    "icp": (Icp, preset_icp),
    "svgd": (Svgd, preset_svgd),
    "cvo": (Cvo, preset_cvo),
    "cvo_no_free_space": (Cvo, preset_cvo_no_free_space),
    "medial_constraint": (MedialConstraint, preset_medial_constraint),
    "medial_constraint_cma_me": (MedialConstraintCmaMe, preset_medial_constraint_cma_me),
    "anchored": (Anchored, preset_anchored),
}
OURS = tuple(_OURS)
METHODS = (*OURS, *(name for name in installed_names() if name not in OURS))


def preset_settings(name: str, preset: str = "default") -> Any:
    """The settings of a method by name, as a preset has them."""
    _, of_preset = _entry(name)
    require_choice("preset", preset, presets.PRESETS)
    return of_preset(preset)


def build_method(name: str, settings: Any = None) -> Method:
    """A method by name.

    settings: its settings, a mapping of them (unnamed ones keep their default), or None for the
    default preset. Raises SettingError for names and values that do not exist, and for a name of
    ours that an installed package gives to a method, too.
    """
    make, preset = _entry(name)
    if name in OURS and (offering := offering_packages(name)):
        raise SettingError(f"method {name} is of package {offering[0]}, too; accepted: one of them")
    default = preset("default")
    if settings is None:
        settings = default
    elif isinstance(settings, Mapping):
        settings = build_settings(type(default), settings, "method")
    kind = type(default)
    require_instance("settings", settings, kind, f"a mapping, or a {kind.__name__}")
    return make(settings)


def noise_of(method: Method) -> float | None:
    """The noise of known points by a method's settings, metres; None if it has no such setting."""
    return method.settings.noise if isinstance(method.settings, AnchoredSettings) else None


def _entry(name: str) -> tuple[Callable[[Any], Method], Callable[[str], Any]]:
    """What makes a method of its settings, and its settings by preset."""
    require_choice("method", name, METHODS)
    return _OURS[name] if name in OURS else installed_method(name)
