"""What an evaluation calls its definition of the plausible set, so that no two have one name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from chsel.plausible.plausible_settings import PlausibleSettings, definition_name
from chsel.problem.settings import build_settings

_COMBINED = {"sums": "sums over points (the paper's)", "means": "means over points"}


def definition_settings(definition: Mapping[str, Any], epsilon: float | None) -> PlausibleSettings:
    """The settings of a choice `definition` of a command, checked.

    definition: plain values with a name. epsilon: metres, that of the object, for a definition
    that has none of its own.
    """
    values = {key: value for key, value in definition.items() if key != "name"}
    if values.get("epsilon") is None:
        values["epsilon"] = epsilon
    return build_settings(PlausibleSettings, values, "definition")


def definition_label(definition: Mapping[str, Any]) -> str:
    """The name of a definition as tables have it: two that differ never have the same one.

    A definition whose settings were changed is the name of the one it was, "~", and the start of
    the digest of its settings.
    """
    settings = definition_settings(definition, 1.0)
    name = definition_name(settings)
    if name is not None and definition.get("epsilon") is None:
        return name
    return f"{definition.get('name', 'own')}~{settings.digest[:8]}"


def definition_text(definition: Mapping[str, Any]) -> str:
    """The label of a definition, and which poses are members by it."""
    cost = definition_settings(definition, 1.0).cost
    epsilon = definition.get("epsilon")
    bound = "that of each object" if epsilon is None else f"{1000.0 * epsilon:g} mm"
    return (
        f"{definition_label(definition)}, cost by {_COMBINED[cost.combine]}, free points at most "
        f"{1000.0 * cost.tolerance:g} mm inside of members, epsilon {bound}"
    )
