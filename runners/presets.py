"""The presets of methods and sessions as choices that Hydra's files can name."""

from __future__ import annotations

from hydra.core.config_store import ConfigStore

from chsel.methods import METHODS, preset_settings
from chsel.presets import PRESETS
from chsel.settings import settings_mapping
from runners.sessions.probing import PROBING_PRESETS


def store_presets() -> None:
    """Offer every preset as method/presets/METHOD/PRESET and session/presets/probing/PRESET."""
    store = ConfigStore.instance()
    for preset in PRESETS:
        for method in METHODS:
            settings = settings_mapping(preset_settings(method, preset))
            store.store(group=f"method/presets/{method}", name=preset, node=settings)
        probing = settings_mapping(PROBING_PRESETS[preset])
        probing["configuration"] = "${configuration}"  # a key of the top file, for short commands
        store.store(group="session/presets/probing", name=preset, node=probing)
