"""The presets of methods and sessions as choices that Hydra's files can name."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from hydra.core.config_store import ConfigStore

from chsel.errors import SettingError
from chsel.methods import METHODS, OURS, preset_settings
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.presets import PRESETS
from chsel.problem.settings import settings_mapping
from runners.sensors.rig import Rig
from runners.sessions.probing import PROBING_PRESETS


def store_presets() -> None:
    """Offer every preset as method/presets/METHOD/PRESET and session/presets/probing/PRESET.

    session/presets/rig/default has all keys of a rig, so that each can be changed by its name.
    definition/NAME is a definition of plausible sets.

    A method of an installed package is a choice of its own, as those of conf/method/ are.
    """
    store = ConfigStore.instance()
    for method in OURS:
        _store_presets_of(store, method)
    for method in METHODS[len(OURS) :]:
        choice: dict[str, Any] = {"name": method}
        with suppress(SettingError):  # whoever chooses it is told
            _store_presets_of(store, method)
            choice["defaults"] = [{f"presets/{method}@_here_": "${preset}"}, "_self_"]
        store.store(group="method", name=method, node=choice)
    for preset in PRESETS:
        probing = settings_mapping(PROBING_PRESETS[preset])
        probing["configuration"] = "${configuration}"  # a key of the top file, for short commands
        store.store(group="session/presets/probing", name=preset, node=probing)
    rig = settings_mapping(Rig(name="", world=""))  # what a rig's file leaves out
    del rig["name"], rig["world"]
    store.store(group="session/presets/rig", name="default", node=rig)
    for name in DEFINITIONS:
        values = settings_mapping(plausible_settings(name, 1.0))
        # None: that of the object.
        store.store(group="definition", name=name, node={"name": name, **values, "epsilon": None})


def _store_presets_of(store: ConfigStore, method: str) -> None:
    for preset in PRESETS:
        settings = settings_mapping(preset_settings(method, preset))
        store.store(group=f"method/presets/{method}", name=preset, node=settings)
