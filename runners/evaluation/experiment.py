"""The folder of an evaluation: its experiment.json, who may write, and its two tables."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
from filelock import FileLock, Timeout

from chsel.errors import RecordingError, SettingError
from chsel.problem.settings import settings_mapping
from replay.environment import environment
from replay.files import WritingError, whole_file
from runners.evaluation.metrics import definition_label
from runners.evaluation.plan import Plan
from runners.evaluation.table import TABLES, joined_parts, write_table
from runners.evaluation.trial_configurations import SENSORS

FILE = "experiment.json"
LOCK = ".lock"
FORMAT = 1
_FIXED = (
    "format",
    "preset",
    "session",
    "objects",
    "definition",
    "metrics",
    "steps",
    "starts",
    "iterations",
    "logs",
    "truth",
    "plausible",
    "steered",
)


@contextmanager
def writing_alone(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Keep other runs out of the folder of an evaluation; waits while one of them is at work.

    The operating system lifts the lock of a process that ends. On a file system without locks
    nobody is kept out: two runs would do the same work there, and write the same whole files.
    say: shows a line.
    """
    lock = FileLock(folder / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        say(f"another run is at work in {folder}; this one waits until it ends")
        lock.acquire()
    except NotImplementedError:
        pass
    except OSError as error:
        raise WritingError(
            f"{lock.lock_file} cannot be written ({error.strerror or error}); accepted: an out=DIR "
            "that can be written"
        ) from error
    try:
        yield
    finally:
        lock.release()


def collect(folder: Path) -> pa.Table:
    """Write results and, where iterations are measured, iterations; the former.

    An evaluation of policies has probes in place of both. Every part that exists is in them,
    whoever made it and when.
    """
    experiment = read_experiment(folder)
    if experiment["policies"]:
        return write_table(folder, "probes", gathered(folder, experiment, "probes"))
    if experiment["iterations"]["every"] is not None:
        write_table(folder, "iterations", gathered(folder, experiment, "iterations"))
    return write_table(folder, "results", gathered(folder, experiment, "results"))


def gathered(folder: Path, experiment: Mapping[str, Any], name: str) -> pa.Table:
    """One of TABLES, of the parts that are finished."""
    suffixes = (".iterations.parquet",) if name == "iterations" else (".parquet", ".failed.parquet")
    parts = list(_parts(folder, experiment, *suffixes))
    return joined_parts(parts, TABLES[name], definition_label(experiment["definition"]))


def join_experiment(
    plan: Plan, name: str, configurations: Sequence[str], seeds: Sequence[int]
) -> None:
    """Make the folder of an evaluation, or add to what is planned in it.

    Configurations, seeds and methods may become more. Raises SettingError, naming what differs, if
    the folder was made with other settings, or is not of an evaluation.
    """
    path = plan.folder / FILE
    ours = _described(plan, name, configurations, seeds)
    if path.exists():
        theirs = read_experiment(plan.folder)
        _check_same(plan.folder, theirs, ours)
        ours = _united(plan, theirs, ours)
    elif (plan.folder / "trials").exists():
        raise SettingError(f"{plan.folder} has trials but no {FILE}; accepted: another out=DIR")
    _write(path, ours)


def add_environments(folder: Path, environments: Iterable[Mapping[str, str]]) -> None:
    """Note those of workers which differ from what experiment.json has."""
    values = read_experiment(folder)
    others = values["other_environments"]
    new = [one for one in environments if one not in [values["environment"], *others]]
    if new:
        _write(folder / FILE, {**values, "other_environments": [*others, *new]})


def read_experiment(folder: Path) -> dict[str, Any]:
    """What experiment.json says. Raises RecordingError if it is damaged or missing."""
    path = folder / FILE
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path} cannot be read ({error}); accepted: a folder that runners.evaluate has written"
        ) from None
    return dict(values)


def _write(path: Path, values: Mapping[str, Any]) -> None:
    with whole_file(path) as beside:
        beside.write_text(json.dumps(values, indent=2) + "\n")


def _parts(folder: Path, experiment: Mapping[str, Any], *suffixes: str) -> Iterable[Path]:
    """Of every trial and label the first file with one of the suffixes."""
    labels = [*experiment["policies"]] or [*experiment["methods"], *experiment["outside"]]
    for configuration in experiment["configurations"]:
        for seed in experiment["seeds"]:
            trial = folder / "trials" / configuration / f"seed_{seed}"
            for label in labels:
                files = (trial / f"{label}{suffix}" for suffix in suffixes)
                yield from [file for file in files if file.exists()][:1]


def _described(
    plan: Plan, name: str, configurations: Sequence[str], seeds: Sequence[int]
) -> dict[str, Any]:
    values = {
        "format": FORMAT,
        "name": name,
        "preset": plan.preset,
        "configurations": list(configurations),
        "seeds": list(seeds),
        "methods": {label: one.config for label, one in plan.contenders.items()},
        "outside": {label: str(folder) for label, folder in plan.outside.items()},
        "session": dict(plan.session),
        "objects": plan.objects,
        "definition": dict(plan.definition),
        "metrics": settings_mapping(plan.metrics),
        "steps": plan.steps,
        "starts": plan.starts,
        "iterations": {"every": plan.every},
        "logs": None if plan.logs is None else str(plan.logs),
        "truth": settings_mapping(plan.truth) if plan.kind == SENSORS else None,
        "plausible": plan.plausible,
        "policies": {label: one.config for label, one in plan.policies.items()},
        "steered": bool(plan.policies),
        "commands": [_command()],
        "environment": environment(),
        "other_environments": [],
    }
    return json.loads(json.dumps(values))  # as it will be read: lists for tuples


def _command() -> str:
    """The command line that this process was started with, its interpreter left out."""
    name = getattr(getattr(sys.modules.get("__main__"), "__spec__", None), "name", None)
    program = f"python -m {name}" if name else Path(sys.argv[0]).name
    return " ".join([program, *(shlex.quote(argument) for argument in sys.argv[1:])])


def _check_same(folder: Path, theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    """Raise SettingError where what may not become more differs."""

    def fixed(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
        found = {key: values.get(key) for key in _FIXED}
        if ours["steered"]:
            found["methods"] = list(values["methods"])
        for kind in ("methods", "policies"):
            shared = {label: one for label, one in values[kind].items() if label in others[kind]}
            found |= {f"{kind}.{label}": one for label, one in shared.items()}
        return dict(flattened(found))

    before, now = fixed(theirs, ours), fixed(ours, theirs)
    differing = [
        f"{path} is {now.get(path)!r}, was {before.get(path)!r}"
        for path in dict.fromkeys([*before, *now])
        if now.get(path) != before.get(path)
    ]
    if differing:
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise SettingError(
            f"{folder} was made with other settings: {'; '.join(differing[:3])}{more}; accepted: "
            "the same ones, or another out=DIR"
        )


def flattened(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Nested values by their paths."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _united(plan: Plan, theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> dict[str, Any]:
    both = {*theirs["configurations"], *ours["configurations"]}
    known, here = [theirs["environment"], *theirs["other_environments"]], ours["environment"]
    return {
        **ours,
        "name": theirs["name"],
        "configurations": [name for name in plan.configurations if name in both],
        "seeds": sorted({*theirs["seeds"], *ours["seeds"]}),
        **{kind: {**theirs[kind], **ours[kind]} for kind in ("methods", "outside", "policies")},
        "commands": list(dict.fromkeys([*theirs["commands"], *ours["commands"]])),
        "environment": known[0],
        "other_environments": known[1:] + [here] * (here not in known),
    }
