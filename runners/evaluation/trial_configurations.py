"""Configurations, levels of faults and seeds of an evaluation, and which of them are chosen."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml

from chsel.errors import SettingError
from chsel.problem.settings import build_settings, settings_mapping
from runners.objects.loader import OBJECTS, ObjectConfig
from runners.sessions.configurations import CONFIGURATIONS
from runners.sessions.faults import CLEAN, LEVELS
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS

SENSORS = "sensors"
MOST_PROBES = 1_000
OBJECT_FILE = "object.yaml"
MOST_SEEDS = 100_000
SEED_LIMIT = 2**63  # a column of the table holds them
_RANGE = re.compile(r"(\d{1,19})\.\.(\d{1,19})")
_ACCEPTED = "accepted: a choice of object=, with any other of its keys, such as name: drill"


@dataclass(frozen=True)
class TrialConfiguration:
    """One configuration as evaluations know it."""

    name: str  # with the level of faults, unless it is CLEAN
    object: str
    probes: int | None = None  # how many; None: its logs tell
    log_folder: Path | None = None  # of recorded logs, with OBJECT_FILE; None: they are simulated
    faults: str = CLEAN  # the level of faults in its sessions, see LEVELS

    @property
    def clean_name(self) -> str:
        """The name of the same configuration without faults."""
        return self.name.removesuffix(f"+{self.faults}")


def configurations_of(kind: str, logs: Path | None = None) -> dict[str, TrialConfiguration]:
    """All configurations of a kind of session, by name.

    Those of sessions of sensors are the folders in `logs`, and the simulated robot's where there
    are no others. Raises SettingError for a folder that does not exist or does not name its object.
    """
    known = CABINET_CONFIGURATIONS if kind == SENSORS else CONFIGURATIONS
    simulated = {
        name: TrialConfiguration(name, one.object, len(one.grid)) for name, one in known.items()
    }
    if kind != SENSORS or logs is None:
        return simulated
    if not logs.is_dir():
        raise SettingError(
            f"session.logs is {logs}; accepted: a folder with CONFIGURATION/seed_0.mcap and "
            f"CONFIGURATION/{OBJECT_FILE}, or an empty one for logs of the simulated robot"
        )
    there = {path.name: path for path in sorted(logs.iterdir()) if path.is_dir()}
    if set(there) <= set(simulated):
        return simulated
    return {name: simulated.get(name) or _recorded(name, path) for name, path in there.items()}


def with_faults(
    configurations: Mapping[str, TrialConfiguration],
) -> dict[str, TrialConfiguration]:
    """Configurations without faults, each followed by itself with every level of them."""
    return {
        (name := faulty_name(clean, level)): replace(one, name=name, faults=level)
        for clean, one in configurations.items()
        for level in LEVELS
    }


def faulty_name(configuration: str, level: str) -> str:
    """The name of a configuration with a level of faults."""
    return configuration if level == CLEAN else f"{configuration}+{level}"


def object_values(name: str) -> dict[str, Any]:
    """What the choice object=NAME says."""
    if name not in OBJECTS:
        raise SettingError(
            f"object {name!r} does not exist; accepted: {', '.join(sorted(OBJECTS))}"
        )
    return settings_mapping(OBJECTS[name])


def recorded_object(configuration: TrialConfiguration) -> ObjectConfig:
    """The object of a folder of logs, at its real size unless its file gives another scale.

    `name` alone, of a model of our own (or `ycb/NAME` of a scan), or with other keys of
    the object; a `path` is relative to the folder. Raises SettingError for anything else.
    """
    assert configuration.log_folder is not None
    file = configuration.log_folder / OBJECT_FILE
    given = _object_file(file)
    name = str(given["name"])
    known = name in OBJECTS
    values = object_values(name) if known else {"kind": "file", "epsilon": 0.001}
    values |= {"scale": 1.0, "configuration": configuration.name}
    values |= {**given, "name": values.get("name", name)}
    if values.get("path") is not None:
        values["path"] = str(file.parent / Path(str(values["path"])).expanduser())
    return build_settings(ObjectConfig, values, str(file))


def _recorded(name: str, folder: Path) -> TrialConfiguration:
    given = _object_file(folder / OBJECT_FILE)
    return TrialConfiguration(name, str(given["name"]).rpartition("/")[2], None, folder)


def _object_file(path: Path) -> Mapping[str, Any]:
    try:
        values = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise SettingError(f"{path} is missing; {_ACCEPTED}") from None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise SettingError(
            f"{path} cannot be read ({' '.join(str(error).split())}); {_ACCEPTED}"
        ) from None
    if not isinstance(values, dict) or not isinstance(values.get("name"), str):
        raise SettingError(f"{path} has no name; {_ACCEPTED}")
    return {str(key): value for key, value in values.items()}


def chosen_configurations(
    value: Any, existing: Mapping[str, TrialConfiguration]
) -> tuple[str, ...]:
    """Which of the existing configurations a value names, in the order of all of them.

    As `chosen_names`, or an object: all of its configurations, unless one has the same name.
    """
    objects: dict[str, list[str]] = {}
    for name, one in existing.items():
        objects.setdefault(one.object, []).append(name)
    return chosen_names("configurations", value, existing, objects)


def chosen_names(
    setting: str, value: Any, existing: Iterable[str], groups: Mapping[str, list[str]] | None = None
) -> tuple[str, ...]:
    """Which of the existing names a setting has, in the order of all of them.

    A name, a pattern such as noise_*, "all", or a list of these. groups: names for several, here
    of objects. Raises SettingError if one of them names none.
    """
    names, chosen = list(existing), set()
    for text in map(str, _listed(setting, value)):
        named = names if text == "all" else [name for name in names if name == text]
        named = named or (groups or {}).get(text, [])
        named = named or [name for name in names if fnmatchcase(name, text)]
        if not named:
            accepted = "all, an object" if groups else "all"
            raise SettingError(
                f"{setting} names {text!r}; accepted: {accepted}, a pattern such as "
                f"{names[0][:3]}*, {', '.join(names)}"
            )
        chosen.update(named)
    return tuple(name for name in names if name in chosen)


def chosen_seeds(value: Any) -> tuple[int, ...]:
    """The seeds that a value names, ascending: 3, [0, 1], "0..9" or a list of these."""
    chosen: set[int] = set()
    for part in _listed("seeds", value):
        chosen.update(_seeds(part))
    return tuple(sorted(chosen))


def _listed(name: str, value: Any) -> list[Any]:
    parts = value if isinstance(value, list | tuple) else [value]
    listed = [
        one
        for part in parts
        for one in (map(str.strip, part.split(",")) if isinstance(part, str) else [part])
    ]
    if not listed or any(part is None or part == "" for part in listed):
        raise SettingError(f"{name} is {value!r}; accepted: at least one, or a list")
    return listed


def _seeds(part: Any) -> Iterable[int]:
    match = _RANGE.fullmatch(str(part))
    if match is not None:
        first, last = int(match[1]), int(match[2])
        if first <= last < min(first + MOST_SEEDS, SEED_LIMIT):
            return range(first, last + 1)
    elif re.fullmatch(r"\d{1,20}", str(part)) and int(part) < SEED_LIMIT:
        return [int(part)]
    raise SettingError(f"seeds names {part!r}; accepted: such as 3, [0,1] or 0..9, below 2^63")
