"""What the code knows as choices for Hydra: the same as files in conf/ would be."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from hydra.core.config_store import ConfigStore

from chsel.errors import SettingError
from chsel.methods import METHODS, preset_settings
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.problem.settings import PRESETS, in_preset, settings_mapping
from runners.sensors.rig import Rig
from runners.sessions.probing import ProbingSettings


def store_choices() -> None:
    """Offer preset/PRESET, method/METHOD, definition/NAME and the simulated sessions.

    session/presets/rig/default has all keys of a rig, so that each can be changed by its name.
    """
    for preset in PRESETS:
        _store("preset", preset, {"name": preset})
    for method in METHODS:
        _store_with_presets("method", method, partial(preset_settings, method), {"name": method})
    for kind in ("simulated", "kinematic"):  # in PyBullet, and by geometry without an engine
        # configuration: a key of the top file, for short commands
        node = {"kind": kind, "configuration": "${configuration}"}
        _store_with_presets("session", kind, partial(in_preset, ProbingSettings()), node)
    for name in DEFINITIONS:
        values = settings_mapping(plausible_settings(name, 1.0))
        # None: that of the object.
        _store("definition", name, {"name": name, **values, "epsilon": None})
    rig = settings_mapping(Rig(name="", world=""))  # what a rig's file leaves out
    del rig["name"], rig["world"]
    _store("session/presets/rig", "default", rig)


def _store_with_presets(
    group: str, name: str, settings: Callable[[str], Any], node: dict[str, Any]
) -> None:
    """GROUP/NAME: its settings in the preset chosen, which are GROUP/presets/NAME/PRESET."""
    with suppress(SettingError):  # of an installed method; whoever chooses it gets the message
        for preset in PRESETS:
            _store(f"{group}/presets/{name}", preset, settings_mapping(settings(preset)))
        node = {"defaults": [{f"presets/{name}@_here_": "${preset}"}, "_self_"], **node}
    _store(group, name, node)


def _store(group: str, name: str, node: dict[str, Any]) -> None:
    ConfigStore.instance().store(group=group, name=name, node=node)
