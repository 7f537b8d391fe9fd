"""The choices of the commands: the files of conf/, and those that Hydra takes from the code."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from chsel.errors import SettingError
from chsel.methods import METHODS, default_method, preset_settings
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.policies import POLICIES, policy_settings
from chsel.problem.settings import PRESETS, in_preset, settings_mapping
from runners.command.arguments import hydra_arguments
from runners.objects.loader import OBJECTS
from runners.sensors.rig import Rig
from runners.sessions.faults import CLEAN, LEVELS
from runners.sessions.probing_settings import ProbingSettings

CONF = Path(__file__).resolve().parents[2] / "conf"
NESTED_GROUPS = (
    "session/rig",
    "session/faults",
)  # choices of their own, not options of the group around them


def calls_for_anchored(session: str, policy: str) -> str:
    """The choice, as typed, for which the default of method= is `default_method`; "" if none is."""
    if policy != "grid":
        return f"policy={policy}"
    return f"session={session}" if session in ("points", "sensors") else ""


def _method(session: str, policy: str, preset: str) -> str:
    return default_method(preset) if calls_for_anchored(session, policy) else "chsel"


# Here, as processes of launchers compose configurations and have no more than the imports.
OmegaConf.register_new_resolver("default_method", _method, replace=True)


def prepared(config_name: str, words: list[str]) -> list[str]:
    """The arguments of a command as Hydra takes them, which has all choices to choose from."""
    store_choices()
    OmegaConf.register_new_resolver("options", _options, replace=True)
    return hydra_arguments(config_name, words)


@cache
def store_choices() -> None:
    """Offer presets, methods, policies, definitions, simulated sessions and their faults, by name.

    Once in a process.
    session/presets/rig/default has all keys of a rig, so that each can be changed by its name.
    """
    for preset in PRESETS:
        _store("preset", preset, {"name": preset})
    for method in METHODS:
        _store_with_presets("method", method, partial(preset_settings, method), {"name": method})
    for policy in POLICIES:
        with suppress(SettingError):  # of an installed policy; who chooses it gets the message
            _store("policy", policy, {"name": policy, **settings_mapping(policy_settings(policy))})
    for kind in ("simulated", "kinematic"):  # in PyBullet, and by geometry without an engine
        # configuration: a key of the top file, for short commands
        node = {"kind": kind, "configuration": "${configuration}"}
        settings = partial(in_preset, ProbingSettings())
        _store_with_presets("session", kind, settings, node, {"faults": CLEAN})
    for choice, config in OBJECTS.items():
        group, _, name = f"object/{choice}".rpartition("/")
        ConfigStore.instance().store(name, settings_mapping(config), group, package="object")
    mesh = {"name": "mesh", "kind": "file", "scale": 1.0, "epsilon": 0.001, "scan": None}
    _store("object", "mesh", {**mesh, "configuration": "drill", "path": None})
    for level, faults in LEVELS.items():
        _store("session/faults", level, settings_mapping(faults))
    for name in DEFINITIONS:
        values = settings_mapping(plausible_settings(name, 1.0))
        # None: that of the object.
        _store("definition", name, {"name": name, **values, "epsilon": None})
    rig = settings_mapping(Rig(name="", world=""))  # what a rig's file leaves out
    del rig["name"], rig["world"]
    _store("session/presets/rig", "default", rig)


def _store_with_presets(
    group: str,
    name: str,
    settings: Callable[[str], Any],
    node: dict[str, Any],
    *choices: dict[str, str],
) -> None:
    """GROUP/NAME: its settings in the preset chosen, which are GROUP/presets/NAME/PRESET.

    choices: of groups below GROUP, with their usual option.
    """
    with suppress(SettingError):  # of an installed method; who chooses it gets the message
        for preset in PRESETS:
            _store(f"{group}/presets/{name}", preset, settings_mapping(settings(preset)))
        defaults = [{f"presets/{name}@_here_": "${preset}"}, *choices, "_self_"]
        node = {"defaults": defaults, **node}
    _store(group, name, node)


def _store(group: str, name: str, node: dict[str, Any]) -> None:
    ConfigStore.instance().store(group=group, name=name, node=node)


def choices(group: str) -> list[str]:
    """The options of a group: the files of conf/, of nested folders with their path, and more.

    These are what `store_choices` offers, such as methods.
    """
    folder = CONF / group
    nested = [CONF / name for name in NESTED_GROUPS if name != group]
    files = [file.relative_to(folder) for file in folder.rglob("*.yaml")]
    names = [
        str(file.with_suffix(""))
        for file in files
        if not any((folder / file).is_relative_to(other) for other in nested)
    ]
    stored = ConfigStore.instance().repo
    for part in group.split("/"):
        stored = stored.get(part, {})
    names += [Path(name).stem for name in stored if name.endswith(".yaml")]
    nested_names = [name.rpartition("/")[2] for name in NESTED_GROUPS]
    for name, options in stored.items():
        if isinstance(options, dict) and name not in ("presets", *nested_names):
            names += [f"{name}/{Path(option).stem}" for option in options]
    return sorted(names, key=lambda name: (name.count("/"), name))


def _options(*groups: str) -> str:
    """What the help texts in conf/ use: ${options:object,session} lists the options of groups."""
    return "\n".join(f"  {group}={'|'.join(choices(group))}" for group in groups)
