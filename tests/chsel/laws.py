"""Laws for all: decorators that run a test on every method in every preset, or on every policy."""

import pytest

from chsel.methods import METHODS, build_method, preset_settings
from chsel.policies import POLICIES
from chsel.problem.settings import PRESETS, settings_mapping

_QUICK = {
    "descent": {"restarts": 2, "iterations": 15},
    "emitter": {"iterations": 6},
    "cma_es": {"generations": 15},
}


def quick(name, preset="default", **changes):
    """A method that searches as briefly as its stages allow. changes: to its settings."""
    settings = settings_mapping(preset_settings(name, preset))
    for group in _QUICK.keys() & settings.keys():
        settings[group] |= _QUICK[group]
    for count in {"iterations", "max_iterations"} & settings.keys():
        settings[count] = 8
    if name == "anchored":
        settings["size"] = "small"
    return build_method(name, settings | changes)


def every_method(law):
    """Run a law(name, preset) on all methods and presets."""
    cases = [(name, preset) for name in METHODS for preset in PRESETS]
    ids = [f"{name}-{preset}" for name, preset in cases]
    return pytest.mark.parametrize(("name", "preset"), cases, ids=ids)(law)


def every_policy(law):
    """Run a law(name) on all policies."""
    return pytest.mark.parametrize("name", POLICIES)(law)
