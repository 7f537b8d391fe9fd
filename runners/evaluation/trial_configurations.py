"""Configurations, levels of faults and seeds of an evaluation, and which of them are chosen."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from chsel.errors import ChselError, SettingError, require_choice
from chsel.problem.settings import build_settings, settings_mapping
from runners.objects.loader import HOUSEHOLDS, OBJECTS, ObjectConfig
from runners.sensors.pose_file import read_yaml
from runners.sessions.configurations import CONFIGURATIONS
from runners.sessions.faults import CLEAN, LEVELS
from runners.sessions.fitted import FITTED_PROBES
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS

SENSORS = "sensors"
HOUSEHOLD = "households"
MOST_PROBES = 1_000
OBJECT_FILE = "object.yaml"
_SEED_LIMIT = 2**63  # a column of the table holds them
_SEEDS = re.compile(r"(\d{1,20})(?:\.\.(\d{1,20}))?")
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
    """Return all configurations of a kind of session, by name, with levels of faults if simulated.

    Those of sessions of sensors are the folders in `logs`, and the simulated robot's where there
    are no others. Raise SettingError for a folder that does not exist or does not name its object.
    """
    known = CABINET_CONFIGURATIONS if kind == SENSORS else CONFIGURATIONS
    simulated = {
        name: TrialConfiguration(name, one.object, probes=len(one.grid))
        for name, one in known.items()
    }
    if kind != SENSORS:
        return {
            (name := faulty_name(clean, level)): replace(one, name=name, faults=level)
            for clean, one in simulated.items()
            for level in LEVELS
        }
    if logs is None:
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


def household_configurations() -> dict[str, TrialConfiguration]:
    """Return a configuration for each household object, by name, with levels of faults."""
    return {
        (name := faulty_name(thing, level)): TrialConfiguration(
            name, thing, probes=FITTED_PROBES, faults=level
        )
        for thing in HOUSEHOLDS
        for level in LEVELS
    }


def faulty_name(configuration: str, level: str) -> str:
    """Return the name of a configuration with a level of faults."""
    return configuration if level == CLEAN else f"{configuration}+{level}"


def object_values(name: str) -> dict[str, Any]:
    """Return the values of the choice object=NAME."""
    require_choice("object", name, accepted=sorted(OBJECTS))
    return settings_mapping(OBJECTS[name])


def recorded_object(configuration: TrialConfiguration) -> ObjectConfig:
    """Return the object of a folder of logs, at its real size unless its file gives another scale.

    `name`, of a model or of a scan, or with other keys; a `path` is relative to the folder.
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
    return build_settings(ObjectConfig, values, where=str(file))


def _recorded(name: str, folder: Path) -> TrialConfiguration:
    given = _object_file(folder / OBJECT_FILE)["name"]
    if not isinstance(given, str):
        raise SettingError(f"{folder / OBJECT_FILE} has no name; {_ACCEPTED}")
    return TrialConfiguration(name, given.rpartition("/")[2], probes=None, log_folder=folder)


def _object_file(path: Path) -> Mapping[str, Any]:
    try:
        return {"name": None, **read_yaml(path)}
    except ChselError as error:
        raise SettingError(f"{path}: {error}; {_ACCEPTED}") from None


def chosen_names(
    setting: str,
    value: Any,
    *,
    existing: Iterable[str],
    every: Iterable[str] | None = None,
    objects: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Return the existing names that a setting chooses, in the order of all of them.

    A name, an object, a pattern such as noise_*, "all", or a list of these. every: the names that
    "all" chooses; None for all existing ones. objects: by name.
    """
    names = list(existing)
    chosen = set()
    for text in map(str, _listed(setting, value)):
        if text == "all":
            named = names if every is None else list(every)
        else:
            named = [name for name in names if name == text]
        named = named or [name for name in names if (objects or {}).get(name) == text]
        named = named or [name for name in names if fnmatchcase(name, text)]
        if not named:
            accepted = "all, an object" if objects else "all"
            raise SettingError(
                f"{setting} names {text!r}; accepted: {accepted}, a pattern such as "
                f"{names[0][:3]}*, {', '.join(names)}"
            )
        chosen.update(named)
    return tuple(name for name in names if name in chosen)


def chosen_seeds(value: Any) -> tuple[int, ...]:
    """Return the seeds that a value names, ascending: 3, [0, 1], "0..9" or a list of these."""
    chosen: set[int] = set()
    for part in _listed("seeds", value):
        match = _SEEDS.fullmatch(str(part))
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < min(first + 100_000, _SEED_LIMIT):
            raise SettingError(
                f"seeds names {part!r}; accepted: such as 3, [0,1] or 0..9, below 2^63"
            )
        chosen.update(range(first, last + 1))
    return tuple(sorted(chosen))


def _listed(name: str, value: Any) -> list[Any]:
    """Return the parts of a setting: those of a list, and of texts what is between commas."""
    parts = value if isinstance(value, list | tuple) else [value]
    listed = [
        one
        for part in parts
        for one in (map(str.strip, part.split(",")) if isinstance(part, str) else [part])
    ]
    if not listed or any(part is None or part == "" for part in listed):
        raise SettingError(f"{name} is {value!r}; accepted: at least one, or a list")
    return listed
