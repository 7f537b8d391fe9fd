"""Registration methods by name: ours, each a file or folder here, and those of other packages."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from chsel.errors import require_choice, require_instance
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
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.settings import PRESETS, Entry, NamedChoices, changed_settings

_OURS: dict[str, Entry[Method]] = {
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
MOST_NOISE = 0.25  # of points, in diameters of the object: more is in millimetres


def _lacks(method: Any) -> str | None:
    """Return why an object with settings is not a method, and what is; None if it is one."""
    if not isinstance(getattr(method, "online", None), OnlineSettings):
        return "no `online`; accepted: a property that returns OnlineSettings"
    if not callable(getattr(method, "register", None)):
        return "no `register`; accepted: register(problem, observer=None)"
    return None


_CHOICES = NamedChoices[Method](
    "method", "chsel.methods", page="docs/writing_a_method.md", ours=_OURS, lacks=_lacks
)
METHODS = _CHOICES.names
build_method, preset_settings = _CHOICES.build, _CHOICES.settings


def default_method(preset: str = "default") -> str:
    """Return the method for a program's points; in the paper's presets the paper's method."""
    require_choice("preset", preset, accepted=PRESETS)
    return "anchored" if preset == "default" else "chsel"


def method_settings(method: str, preset: str, *changes: Any) -> Any:
    """Return the preset's settings with changes over them: mappings, or whole settings."""
    chosen = preset_settings(method, preset)
    for change in changes:
        if dataclasses.is_dataclass(change) and not isinstance(change, type):
            chosen = change
        elif change is not None:
            require_instance(
                "settings",
                change,
                kind=Mapping,
                accepted="a mapping, or the settings of the method",
            )
            chosen = changed_settings(chosen, change, where=f"method={method}: settings")
    return chosen
