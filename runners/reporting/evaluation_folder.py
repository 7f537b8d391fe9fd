"""The files of an evaluation: its settings, its tables as pandas data frames, its recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet

from chsel.errors import ChselError
from runners.evaluation import table
from runners.evaluation.definition import definition_label, definition_text
from runners.evaluation.repeats import repeat_of

EXPERIMENT = "experiment.json"
RESULTS = "results.parquet"
ITERATIONS = "iterations.parquet"
PROBES = "probes.parquet"
_ACCEPTED = "accepted: a folder that runners.evaluate has written"
_SCHEMAS = {RESULTS: table.RESULTS, ITERATIONS: table.ITERATIONS, PROBES: table.PROBES}
_NEEDED = {
    RESULTS: ("object", "configuration", "seed", "method", "step", "status", "diversity"),
    ITERATIONS: ("configuration", "seed", "method", "step", "iteration", "diversity"),
    PROBES: ("object", "configuration", "seed", "policy", "probes", "status", "error", "spread"),
}
_KEYS = ("object", "configuration", "seed", "method", "policy", "status")  # no row is without
_UNNAMED = "an unnamed definition"
TRIAL = ["configuration", "seed"]
"""The columns that tell trials apart."""
Trial = tuple[str, int]
"""Name of the configuration, and seed."""


class ReportError(ChselError):
    """A folder is not an evaluation, or a report on it cannot be made."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluation, as far as it has come."""

    folder: Path
    experiment: Mapping[str, Any]  # the settings of the evaluation, plain values
    # A row per registration with the columns of runners.evaluation.table.RESULTS and `draw`, by
    # which the draws of a method are told apart, 0 for the first. Sorted by object, configuration,
    # seed, method, step and draw; NaN where there is no finite number.
    rows: pd.DataFrame
    iterations: pd.DataFrame  # the same for moments within registrations
    gathered: bool = False  # the rows are those of finished parts, as there is no table of all yet
    definition: str = ""  # label of the definition of the plausible sets behind all PD
    # A row per probe with the columns of runners.evaluation.table.PROBES where policies were
    # evaluated; `rows` has none then. Sorted by object, configuration, seed, policy and step.
    probes: pd.DataFrame = field(default_factory=lambda: _rows([], PROBES))

    @property
    def name(self) -> str:
        """The name that the evaluation was given, else that of its folder."""
        return str(self.experiment.get("name", self.folder.name))

    @property
    def definition_text(self) -> str:
        """The definition of the plausible sets, and which poses are members by it."""
        asked = self.experiment.get("definition")
        if isinstance(asked, Mapping) and _label(asked) == self.definition:
            with suppress(ChselError):  # of another version of this package
                return definition_text(asked)
        return self.definition

    @cached_property
    def objects(self) -> list[str]:
        """Objects with a row."""
        return sorted(self.rows["object"].unique())

    @cached_property
    def methods(self) -> list[str]:
        """Methods with a row."""
        return sorted(self.rows["method"].unique())

    @cached_property
    def last_half(self) -> pd.DataFrame:
        """The rows of the latter half of the steps of every trial."""
        return last_half(self.rows)

    @cached_property
    def planned_trials(self) -> list[Trial]:
        """Trials that were asked for; without that information, those with a row."""
        configurations = _names(self.experiment.get("configurations"))
        seeds = self.experiment.get("seeds")
        if not configurations or not isinstance(seeds, list):
            return sorted(trials_of(self.rows))
        return [(name, seed) for name in configurations for seed in seeds if isinstance(seed, int)]

    @cached_property
    def planned_methods(self) -> list[str]:
        """Labels of methods that were asked for, then the others that have a row."""
        asked = _asked_labels(self.experiment)
        without_draws = [repeat_of(label, asked)[0] for label in asked]
        return list(dict.fromkeys([*without_draws, *self.methods]))

    @property
    def is_steered(self) -> bool:
        """Whether policies were evaluated, not methods."""
        return bool(self.experiment.get("policies"))

    @cached_property
    def planned_policies(self) -> list[str]:
        """Labels of policies that were asked for, then the others that have a row."""
        asked = _names(self.experiment.get("policies"))
        return list(dict.fromkeys([*asked, *sorted(self.probes["policy"].unique())]))

    def trial_folder(self, trial: Trial) -> Path:
        """The folder of the recordings of a trial."""
        configuration, seed = trial
        return self.folder / "trials" / configuration / f"seed_{seed}"

    def recording(self, trial: Trial, method: str) -> Path | None:
        """The recording of a method in a trial, if there is one."""
        path = self.trial_folder(trial) / f"{method}.mcap"
        return path if path.is_file() else None


def trials_of(rows: pd.DataFrame) -> set[Trial]:
    """The trials that have rows."""
    return set(rows[TRIAL].itertuples(index=False, name=None))


def last_half(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the latter half of every trial's steps, the middle one of an odd number too.

    The steps of a trial are those of all methods, so that the half is the same for each.
    """
    with_step = rows[rows["step"].notna()]
    first = with_step.groupby(TRIAL)["step"].transform(
        lambda steps: sorted(steps.unique())[steps.nunique() // 2]
    )
    return with_step[with_step["step"] >= first]


def open_evaluation(folder: Path) -> Evaluation:
    """Read the tables of a folder. Raises ReportError unless it is one of an evaluation."""
    if not folder.is_dir():
        raise ReportError(f"folder {folder} does not exist; {_ACCEPTED}")
    experiment = _experiment(folder / EXPERIMENT)
    if experiment.get("policies"):
        return _open_steered(folder, experiment)
    rows, gathered = _table(folder, RESULTS, "trials/*/seed_*/*.parquet")
    iterations, _ = _table(folder, ITERATIONS, "trials/*/seed_*/*.iterations.parquet")
    labels = {*rows["method"], *_asked_labels(experiment)}
    order = ["object", *TRIAL, "method", "step", "draw"]
    rows = _in_order(rows, labels, order)
    iterations = _in_order(iterations, labels, [*order[1:-1], "iteration", "draw"])
    definition = _definition(folder, experiment, [*rows["definition"], *iterations["definition"]])
    return Evaluation(folder, experiment, rows, iterations, gathered, definition)


def _open_steered(folder: Path, experiment: Mapping[str, Any]) -> Evaluation:
    """An evaluation of policies."""
    probes, gathered = _table(folder, PROBES, "trials/*/seed_*/*.parquet")
    probes = probes.sort_values(["object", *TRIAL, "policy", "step"], na_position="first")
    nothing = _rows([], RESULTS).assign(draw=0)
    return Evaluation(
        folder,
        experiment,
        nothing,
        _rows([], ITERATIONS).assign(draw=0),
        gathered,
        _definition(folder, experiment, []),
        probes.reset_index(drop=True),
    )


def _in_order(rows: pd.DataFrame, labels: set[str], order: list[str]) -> pd.DataFrame:
    """The rows with the label of their method and their draw apart, sorted; no value is first."""
    draws = {label: repeat_of(label, labels) for label in rows["method"].unique()}
    draw = rows["method"].map(lambda label: draws[label][1]).astype(int)
    method = rows["method"].map(lambda label: draws[label][0]).astype(rows["method"].dtype)
    rows = rows.assign(method=method, draw=draw)
    return rows.sort_values(order, kind="stable", na_position="first", ignore_index=True)


def _definition(folder: Path, experiment: Mapping[str, Any], labels: list[Any]) -> str:
    """The label of the one definition of plausible sets by which all rows were measured.

    Rows from before there was a column of it have that of experiment.json. Raises ReportError if
    there are several: medians over numbers by different definitions mean nothing.
    """
    asked = experiment.get("definition")
    usual = _label(asked) if isinstance(asked, Mapping) else _UNNAMED
    labels = sorted({usual if pd.isna(label) or not label else label for label in labels})
    if len(labels) > 1:
        raise ReportError(
            f"{folder} has numbers by {len(labels)} definitions of plausible sets, "
            f"{', '.join(labels)}; accepted: one, so evaluate each into an out=DIR of its own"
        )
    return labels[0] if labels else usual


def _label(definition: Mapping[str, Any]) -> str:
    try:
        return definition_label(definition)
    except ChselError:  # of another version of this package
        return str(definition.get("name") or _UNNAMED)


def _asked_labels(experiment: Mapping[str, Any]) -> list[str]:
    """Labels of methods and of sets from outside that were asked for, those of draws too."""
    return [name for kind in ("methods", "outside") for name in _names(experiment.get(kind))]


def _names(value: Any) -> list[str]:
    """Names in a list, of which some may be mappings with a label or a name, or in a mapping."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        return [str(name) for name in value]
    if not isinstance(value, list):
        return []
    return [
        str(entry.get("label") or entry.get("name")) if isinstance(entry, Mapping) else str(entry)
        for entry in value
    ]


def _experiment(path: Path) -> Mapping[str, Any]:
    try:
        experiment = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ReportError(f"folder {path.parent} has no {path.name}; {_ACCEPTED}") from None
    except (ValueError, OSError) as error:
        raise ReportError(f"{path} cannot be read ({error}); {_ACCEPTED}") from None
    if not isinstance(experiment, Mapping):
        raise ReportError(f"{path} is not a mapping of settings; {_ACCEPTED}")
    return experiment


def _table(folder: Path, name: str, parts: str) -> tuple[pd.DataFrame, bool]:
    """The rows of a table; without one, those of its parts, and whether that was so."""
    if (folder / name).exists():
        return _rows([folder / name], name), False
    paths = [
        path
        for path in sorted(folder.glob(parts))
        if (name == ITERATIONS or not path.name.endswith(".iterations.parquet"))
        and not _done_again(path)
    ]
    return _rows(paths, name), bool(paths)


def _done_again(path: Path) -> bool:
    """Whether a part says how something failed that is there now."""
    name = path.name.removesuffix(".failed.parquet")
    return name != path.name and path.with_name(f"{name}.parquet").exists()


def _rows(paths: Sequence[Path], name: str) -> pd.DataFrame:
    """The rows of some files, with the columns of today: files of before have NaN in later ones."""
    schema = _SCHEMAS[name]
    tables = [schema.empty_table()]
    for path in paths:
        try:
            found = pa.parquet.read_table(path, partitioning=None).replace_schema_metadata()
            if missing := [column for column in _NEEDED[name] if column not in found.column_names]:
                raise ReportError(f"{path} lacks the column {', '.join(missing)}; {_ACCEPTED}")
            columns = [
                found[field.name].cast(field.type)
                if field.name in found.column_names
                else pa.nulls(len(found), field.type)
                for field in schema
            ]
            tables.append(pa.table(columns, schema=schema))
        except (pa.ArrowException, KeyError, OSError) as error:  # two columns of a name: KeyError
            text = " ".join(str(error).split())
            raise ReportError(f"{path} cannot be read as a table ({text}); {_ACCEPTED}") from None
        for column in (column for column in _KEYS if column in _NEEDED[name]):
            if found[column].null_count:
                raise ReportError(f"{path} has a row without {column}; {_ACCEPTED}")
    rows = pa.concat_tables(tables).to_pandas().astype({"step": "Int64"})
    numbers = rows.select_dtypes("float64")
    return rows.assign(**numbers.where(numbers.abs() < math.inf))
