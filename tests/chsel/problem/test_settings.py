"""Settings from mappings and back."""

from __future__ import annotations

import pytest

from chsel.errors import SettingError
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.chsel import ChselSettings
from chsel.problem.settings import PRESETS, build_settings, settings_mapping


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_survives_the_way_through_a_mapping(method: str, preset: str) -> None:
    settings = preset_settings(method, preset)
    assert build_method(method, settings_mapping(settings)).settings == settings


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"cots": {}}, r"method.cots does not exist; did you mean cost\? accepted: archive, cost"),
        ({"cost": {"free_scale": "x"}}, r"method.cost.free_scale is 'x'; accepted: a number"),
        ({"passes": 1.5}, r"method.passes is 1.5; accepted: an integer"),
        ({"passes": True}, r"method.passes is True; accepted: an integer"),
        ({"cost": 3}, r"method.cost is 3; accepted: a group"),
        ({"cost": {"lookup": None}}, r"method.cost.lookup is None; accepted: a text"),
        ({"plane": {"axis": [0, 1], "offset": 0}}, r"method.plane.axis has 2 entries; accepted: 3"),
        ({"archive": {"bins": 0}}, r"method.archive: bins is 0"),
    ],
)
def test_wrong_settings_name_the_key_and_what_is_accepted(
    mapping: dict[str, object], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        build_settings(ChselSettings, mapping, "method")
