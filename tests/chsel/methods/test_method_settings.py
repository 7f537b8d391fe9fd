"""Settings of all methods: presets, single changes, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest

from chsel.cost.cost_settings import CostSettings
from chsel.errors import SettingError
from chsel.methods import OURS, build_method, preset_settings
from chsel.methods.anchored.anchored_settings import AnchoredSettings, Effort
from chsel.methods.cvo import CvoSettings
from chsel.methods.gradient_descent import DescentSettings
from chsel.methods.icp import Icp, IcpSettings
from chsel.methods.medial_constraint import CmaEsSettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.settings import PRESETS, NamedChoices, settings_mapping
from tests.chsel.methods.scene import posed

REFUSED: list[tuple[type[Any], dict[str, Any], str]] = [
    (AnchoredSettings, {"size": "huge"}, "^size is .*accepted: "),
    (Effort, {"samples": 10**12}, "^samples is "),
    (CmaEsSettings, {"starts": "many"}, "^starts is 'many'; accepted: per_start, single"),
    (CmaEsSettings, {"generations": 20_001}, "^generations is 20001; accepted: at most 20_000"),
    (CostSettings, {"penetration_tolerance": 0.01}, "^penetration_tolerance is 0.01"),
    (CostSettings, {"free_term": "interior", "gradient": "exact"}, "piecewise constant.*accepted"),
    (CvoSettings, {"ell_decay": 1.0}, "accepted: at most 0.99"),
    (DescentSettings, {"race": []}, r"^race is \[\]; accepted: null, or shares"),
    (DescentSettings, {"race": [0.5, 0.6]}, "^race is .*none above the one before"),
    (OnlineSettings, {"rotation_law": "uniform"}, "accepted: axis_gauss, rotvec_gauss"),
]


@pytest.mark.parametrize(("settings", "changes", "message"), REFUSED)
def test_values_out_of_bounds_are_refused(settings, changes, message):
    with pytest.raises(SettingError, match=message) as caught:
        settings(**changes)
    assert "accepted: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["anchored", "chsel", "medial_constraint_cma_me"])
def test_a_measure_that_does_not_fit_the_space_is_refused(name):
    method = build_method(name, {"archive": {"measure": "plane_angle"}})
    with pytest.raises(SettingError, match="plane_angle exists only with plane"):
        method.register(posed(method))


@pytest.mark.parametrize("name", OURS)
def test_class_defaults_are_the_default_preset(name):
    settings = preset_settings(name)
    variant = {"chsel_cma_me": {"search": "cma_me"}, "cvo_no_free_space": {"free_space": False}}
    assert settings == replace(type(settings)(), **variant.get(name, {}))
    assert build_method(name).settings == build_method(name, {}).settings == settings


@pytest.mark.parametrize("name", OURS)
def test_one_setting_changes_and_nothing_else(name):
    """Also one of a group, whose other settings have another default in the group's own class."""
    before = settings_mapping(preset_settings(name))
    paths = list(_paths(before))
    assert len(paths) > 5
    for path in paths:
        *groups, last = path
        value = before
        for group in path:
            value = value[group]
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        changes: dict[str, Any] = {last: value + 1 if isinstance(value, int) else 0.9 * value}
        expected = deepcopy(before)
        inner = expected
        for group in groups:
            inner = inner[group]
        inner[last] = changes[last]
        for group in reversed(groups):
            changes = {group: changes}
        assert settings_mapping(build_method(name, changes).settings) == expected, path


def _paths(settings):
    """The paths of all settings that are no groups."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from ((name, *path) for path in _paths(value))
        elif not isinstance(value, Mapping):
            yield (name,)


def test_an_installed_class_may_give_the_settings_of_each_preset():
    class Theirs(Icp):
        @staticmethod
        def preset(name):
            return IcpSettings(iterations=PRESETS.index(name) + 7)

    theirs = {"theirs": (Theirs, IcpSettings())}
    choices = NamedChoices("method", "chsel.methods", page="", ours=theirs, lacks=lambda _: None)
    assert [choices.settings("theirs", name).iterations for name in PRESETS] == [7, 8, 9]
    changed = choices.build("theirs", {"redraw": "registration"}).settings
    assert changed == IcpSettings(iterations=7, redraw="registration")
