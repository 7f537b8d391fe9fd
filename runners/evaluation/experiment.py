"""The folder of an evaluation: its experiment.json, who may write, and its tables of parts."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from filelock import FileLock, Timeout
from pyarrow import csv, parquet

from chsel.errors import RecordingError, SettingError
from replay.environment import environment
from replay.files import whole_file
from runners.evaluation.plan import Plan

FILE = "experiment.json"
_MAY_GROW = ("methods", "outside", "policies")
_MAY_DIFFER = {"name", "configurations", "seeds", "commands", "environments", *_MAY_GROW}
_OF_MACHINE = {"folder", "assets", "recordings"}  # no result depends on these
Row = Mapping[str, Any]
_TEXT = pa.string()
_COUNT = pa.int64()
_NUMBER = pa.float64()
_FLAG = pa.bool_()


def _schema(*columns: tuple[pa.DataType, str]) -> pa.Schema:
    """Return columns by their type; names are separated by spaces."""
    return pa.schema([(name, kind) for kind, names in columns for name in names.split()])


RESULTS = _schema(
    (_TEXT, "object configuration"),
    (_COUNT, "seed"),
    (_TEXT, "method preset definition faults"),
    (_COUNT, "step contacts free_points occupied_points"),
    (_TEXT, "status"),
    (_COUNT, "members kept local"),
    (_NUMBER, "true_cost"),
    (_COUNT, "hypotheses distinct"),
    (_NUMBER, "best_cost mean_cost coverage plausibility diversity root precision recall"),
    (_NUMBER, "position_error rotation_error rank"),
    (_FLAG, "truth_held"),
    (_NUMBER, "nearest_hypothesis nearest_position nearest_rotation exact_members seconds"),
    (_TEXT, "digest problem_digest"),
)
"""A row a (configuration, seed, method, step). Lengths in metres, angles in radians, but coverage,
plausibility and diversity (PD) in mm^2 and root, of PD, in mm. precision: share of hypotheses whose
surface is within 10 mm, root mean square, of that in a plausible pose; recall: share of plausible
poses with such a hypothesis. definition: of the plausible set.
position_error, rotation_error: of the best hypothesis, modulo the object's symmetries, at its
centre. nearest_hypothesis: root mean square distance of the true pose's surface from that of the
nearest hypothesis, whose errors are nearest_position and nearest_rotation. truth_held: whether the
true pose lies in the set that the result stands for, where a method tells. status: "ok", "failed:
REASON" or "no plausible set: REASON"; what a row does not have is null."""
ITERATIONS = _schema(
    (_TEXT, "configuration"),
    (_COUNT, "seed"),
    (_TEXT, "method definition"),
    (_COUNT, "step iteration filled"),
    (_NUMBER, "best_cost mean_cost qd_score coverage plausibility diversity root"),
)
"""A row a (configuration, seed, method, step, iteration) of a search over an archive. Costs and
metrics are of the hypotheses that the method would give if it ended there."""
PROBES = _schema(
    (_TEXT, "object configuration"),
    (_COUNT, "seed"),
    (_TEXT, "policy method preset faults"),
    (_COUNT, "step probes"),
    (_TEXT, "status"),
    (_COUNT, "contacts free_points action"),
    (_FLAG, "hit"),
    (_NUMBER, "hit_forecast forecast_spread surprise seconds decision_seconds"),
    (_COUNT, "hypotheses poses"),
    (_NUMBER, "error best_error belief_error spread promised middle_50 middle_90 grasp_chance"),
    (_FLAG, "modes_90 grasp_works"),
    (_TEXT, "verdict stop digest problem_digest decision_digest"),
)
"""A row a (configuration, seed, policy, probe). Lengths in metres, surprise in nats. probes: how
many are done. action: index of the one that was taken, of those offered. hit: whether it met the
object; hit_forecast, forecast_spread: the chance of it and the spread of the belief afterwards, as
forecast. error: mean distance of the surface in a hypothesis from that in the true pose, of the
last registration; before there is one, belief_error, the same of the belief's poses by their
weights. best_error: the same of the best hypothesis. verdict: how far to trust the registration of
this probe. poses: how many these are. spread: of the belief. promised: by how much the best action
would narrow it. middle_50, middle_90: in which share of the three directions along which members of
a registration's belief spread the most the middle 50 and 90 % of them have the true pose. modes_90:
whether the ellipsoid of 90 % of one of its modes, widened, has it; null without modes.
grasp_chance: of the best of 40 grasps drawn at members; grasp_works: whether it does. stop: why a
session with the usual rules would end here, "" if it goes on."""
TABLES = {"results": RESULTS, "iterations": ITERATIONS, "probes": PROBES}
_ORDER = ("object", "configuration", "seed", "policy", "method", "step", "iteration")


def write_part(path: Path, rows: Sequence[Row], *, schema: pa.Schema, source: str = "") -> None:
    """Write a finished part of a table. source: kept with it, see `part_source`."""
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=schema)
    with whole_file(path) as beside:
        parquet.write_table(table.replace_schema_metadata({"about": source}), beside)


def part_source(path: Path) -> str | None:
    """Return the source that was kept with a part; None if there is no part."""
    if not path.exists():
        return None
    return (parquet.read_schema(path).metadata or {}).get(b"about", b"").decode()


def writing_alone(folder: Path, say: Callable[[str], None]) -> AbstractContextManager[object]:
    """Keep other runs out of the folder of an evaluation; says so and waits while one is there."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock")
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        say(f"another run is at work in {folder}; this one waits until it ends")
        return lock.acquire()


def collect(folder: Path) -> pa.Table:
    """Write NAME.parquet and NAME.csv of each table, of all parts; gives results, or probes."""
    experiment = read_experiment(folder)
    searches = ["iterations"] if experiment["every"] is not None else []
    for name in [*searches, "probes" if experiment["policies"] else "results"]:
        table = gathered(folder, experiment, name=name)
        with whole_file(folder / f"{name}.parquet") as beside:
            parquet.write_table(table, beside)
        with whole_file(folder / f"{name}.csv") as beside:
            csv.write_csv(table, beside)
    return table


def gathered(folder: Path, experiment: Mapping[str, Any], *, name: str) -> pa.Table:
    """Return the rows of one of TABLES, in order, of the parts that are finished."""
    schema = TABLES[name]
    suffixes = (".iterations.parquet",) if name == "iterations" else (".parquet", ".failed.parquet")
    labels = [*experiment["policies"]] or [*experiment["methods"], *experiment["outside"]]
    tables = [schema.empty_table()]
    for configuration in experiment["configurations"]:
        for seed in experiment["seeds"]:
            trial = folder / "trials" / configuration / f"seed_{seed}"
            for label in labels:  # the first file with one of the suffixes
                files = [trial / f"{label}{suffix}" for suffix in suffixes]
                for path in [file for file in files if file.exists()][:1]:
                    part = parquet.read_table(path, partitioning=None)
                    tables.append(part.replace_schema_metadata().cast(schema))
    order = [(key, "ascending") for key in _ORDER if key in schema.names]
    return pa.concat_tables(tables).sort_by(order).combine_chunks()


def join_experiment(
    plan: Plan, name: str, *, configurations: Sequence[str], seeds: Sequence[int]
) -> None:
    """Make the folder of an evaluation, or add configurations, seeds and methods to it.

    Raise SettingError, naming what differs, if it was made with other settings, or is another's.
    """
    path = plan.folder / FILE
    ours = _described(plan, name, configurations=configurations, seeds=seeds)
    if path.exists():
        theirs = read_experiment(plan.folder)
        _check_same(plan.folder, theirs, ours=ours)
        ours |= {kind: {**theirs[kind], **ours[kind]} for kind in _MAY_GROW}
        both = {*theirs["configurations"], *configurations}
        ours["name"] = theirs["name"]
        ours["configurations"] = [name for name in plan.configurations if name in both]
        ours["seeds"] = sorted({*theirs["seeds"], *seeds})
        for kind in ("commands", "environments"):
            ours[kind] = theirs[kind] + [one for one in ours[kind] if one not in theirs[kind]]
    elif (plan.folder / "trials").exists():
        raise SettingError(f"{plan.folder} has trials but no {FILE}; accepted: another out=DIR")
    with whole_file(path) as beside:
        beside.write_text(json.dumps(ours, indent=2) + "\n")


def this_command() -> str:
    """Return the command line of this program."""
    main = getattr(sys.modules.get("__main__"), "__spec__", None)
    program = ["python", "-m", main.name] if main else [Path(sys.argv[0]).name]
    return shlex.join([*program, *sys.argv[1:]])


def read_experiment(folder: Path) -> dict[str, Any]:
    """Return experiment.json; raise RecordingError if it is damaged or missing."""
    path = folder / FILE
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path} cannot be read ({error}); accepted: a folder that runners.evaluate has written"
        ) from None


def _described(
    plan: Plan, name: str, *, configurations: Sequence[str], seeds: Sequence[int]
) -> dict[str, Any]:
    values = {key: value for key, value in asdict(plan).items() if key not in _OF_MACHINE}
    values |= {"methods": values.pop("contenders"), "steered": bool(plan.policies)}
    values |= {"name": name, "configurations": list(configurations), "seeds": list(seeds)}
    values |= {"commands": [this_command()], "environments": [environment()]}
    return dict(json.loads(json.dumps(values, default=str)))  # as it will be read


def _check_same(folder: Path, theirs: Mapping[str, Any], *, ours: Mapping[str, Any]) -> None:
    """Raise SettingError where what may not become more differs."""

    def fixed(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
        found = {key: value for key, value in values.items() if key not in _MAY_DIFFER}
        for kind in ("methods", "policies"):
            found[kind] = {key: one for key, one in values[kind].items() if key in others[kind]}
        return flat(found) | ({"methods": list(values["methods"])} if ours["steered"] else {})

    before, now = fixed(theirs, ours), fixed(ours, theirs)
    differing = [
        f"{path} is {now.get(path)!r}, was {before.get(path)!r}"
        for path in dict.fromkeys([*before, *now])
        if now.get(path) != before.get(path)
    ]
    if differing:
        raise SettingError(
            f"{folder} was made with other settings: {'; '.join(differing[:3])}; accepted: the "
            "same ones, or another out=DIR"
        )


def flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values by their paths."""
    return dict(pd.json_normalize(values).to_dict("records")[0])
