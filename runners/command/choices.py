"""The choices of the commands: the files of conf/, and those that Hydra takes from the code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import MISSING, asdict, fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from chsel.errors import SettingError
from chsel.methods import METHODS, default_method, preset_settings
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.policies import POLICIES, policy_settings
from chsel.problem.settings import PRESETS, in_preset, settings_mapping
from runners.objects.loader import FITTED, OBJECTS, ObjectConfig
from runners.objects.scans import URL
from runners.run.grasps import GraspConfig
from runners.run.recording import RecordingConfig
from runners.sensors.rig import Rig
from runners.sessions import KINDS, kinds_of
from runners.sessions.faults import LEVELS
from runners.sessions.source import ObjectOrigin

CONF = Path(__file__).resolve().parents[2] / "conf"
_OWN_GROUPS = ("presets", "rig", "faults")  # not options of the group around them


def calls_for_anchored(session: str, policy: str) -> str:
    """Return the choice, as typed, that makes `default_method` the default of method=, or ""."""
    if policy != "grid":
        return f"policy={policy}"
    return f"session={session}" if session in kinds_of(ObjectOrigin.REAL) else ""


def _method(session: str, policy: str, preset: str) -> str:  # noqa: PLR0917
    return default_method(preset) if calls_for_anchored(session, policy) else "chsel"


@cache
def store_choices() -> None:
    """Offer all that the code knows by name, with its settings. Once in a process."""
    store(
        "", "base", node={"hydra": {"output_subdir": None, "run": {"dir": "."}}}, package="_global_"
    )
    assets = '${oc.env:CHSEL_ASSETS,"~/.cache/chsel/ycb"}'
    store("assets", "default", node={"dir": assets, "url": URL})
    for choice, config in OBJECTS.items():
        group, _, name = f"object/{choice}".rpartition("/")
        store(group, name, node=settings_mapping(config), package="object")
    mesh = {"name": "mesh", "kind": "file", "scale": 1.0, "epsilon": 0.001}
    mesh |= {"configuration": FITTED}
    store("object", "mesh", node=_defaults(ObjectConfig) | mesh)
    for name, written in (
        ("both", RecordingConfig()),
        ("mcap", RecordingConfig(rerun=False)),
        ("rerun", RecordingConfig(mcap=False)),
        ("none", RecordingConfig(mcap=False, rerun=False)),
    ):
        store("recording", name, node=settings_mapping(written))
    store("grasp", "default", node=settings_mapping(GraspConfig()))
    for preset in PRESETS:
        store("preset", preset, node={"name": preset})
    store("search", "default", node=settings_mapping(TruePoseSettings()))
    for method in METHODS:
        _store_with_presets("method", method, partial(preset_settings, method), {"name": method})
    for policy in POLICIES:
        with suppress(SettingError):  # of an installed policy; who chooses it gets the message
            store(
                "policy", policy, node={"name": policy, **settings_mapping(policy_settings(policy))}
            )
    for name in DEFINITIONS:
        values = settings_mapping(plausible_settings(name, 1.0))
        # None: that of the object.
        store("definition", name, node={"name": name, **values, "epsilon": None})
    _store_sessions()


def _store_sessions() -> None:
    """Store sessions. session/presets/rig/default has all keys of a rig, to be changed by name."""
    for name, kind in KINDS.items():
        node: dict[str, Any] = {"kind": name, **kind.keys}
        if hasattr(kind.settings, "presets"):
            settings = partial(in_preset, kind.settings())
            _store_with_presets("session", name, settings, node, *kind.groups)
        else:
            defaults = {"defaults": [*kind.groups, "_self_"]} if kind.groups else {}
            store("session", name, node=_defaults(kind.settings) | node | defaults)
    for level, faults in LEVELS.items():
        store("session/faults", level, node=settings_mapping(faults))
    rig = settings_mapping(Rig(name="", world=""))  # what a rig's file leaves out
    del rig["name"], rig["world"]
    store("session/presets/rig", "default", node=rig)


def _defaults(settings: type) -> dict[str, Any]:
    """Return the defaults of the fields of a dataclass that have any."""
    found = {}
    for field in fields(settings):
        make = field.default_factory
        value = field.default if make is MISSING else make()
        if value is not MISSING:
            found[field.name] = asdict(value) if is_dataclass(value) else value  # type: ignore[arg-type]
    return found


def _store_with_presets(  # noqa: PLR0917
    group: str,
    name: str,
    settings: Callable[[str], Any],
    node: dict[str, Any],
    *choices: Mapping[str, str],
) -> None:
    """Store GROUP/NAME: settings in the chosen preset, one of GROUP/presets/NAME/PRESET.

    choices: of groups below GROUP, with their usual option.
    """
    with suppress(SettingError):  # of an installed method; who chooses it gets the message
        for preset in PRESETS:
            store(f"{group}/presets/{name}", preset, node=settings_mapping(settings(preset)))
        defaults = [{f"presets/{name}@_here_": "${preset}"}, *choices, "_self_"]
        node = {"defaults": defaults, **node}
    store(group, name, node=node)


def store(group: str, name: str, *, node: dict[str, Any], package: str | None = None) -> None:
    """Offer an option of a group; a command does so for the groups that it alone has."""
    ConfigStore.instance().store(name, node, group or None, package)


def _options(*groups: str) -> str:
    """Return the options of groups, for ${options:object,session} in the help texts of conf/."""
    return "\n".join(f"  {group}={'|'.join(_choices(group))}" for group in groups)


def _choices(group: str) -> list[str]:
    """Return the options of a group: files of conf/, and what is stored, also one folder below."""
    stored = ConfigStore.instance().repo
    for part in group.split("/"):
        stored = stored.get(part, {})
    names = [file.stem for file in (CONF / group).glob("*.yaml")]
    for name, option in stored.items():
        if not isinstance(option, dict):
            names.append(Path(name).stem)
        elif name not in _OWN_GROUPS:
            names += [f"{name}/{Path(nested).stem}" for nested in option]
    return sorted(names, key=lambda name: (name.count("/"), name))


# Here, as processes of launchers compose configurations and have no more than the imports.
OmegaConf.register_new_resolver("default_method", _method, replace=True)
OmegaConf.register_new_resolver("options", _options, replace=True)
store_choices()
