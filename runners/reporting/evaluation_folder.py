"""The files of an evaluation: its settings, and its tables as pandas data frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from chsel.errors import ChselError
from runners.evaluation.contenders import repeat_of
from runners.evaluation.experiment import gathered, read_experiment
from runners.evaluation.metrics import definition_label, definition_text
from runners.evaluation.table import TABLES

_ACCEPTED = "accepted: a folder that runners.evaluate has written"
TRIAL = ["configuration", "seed"]
"""The columns that tell trials apart."""
Trial = tuple[str, int]
"""Name of the configuration, and seed."""


class ReportError(ChselError):
    """A folder is not an evaluation, or a report on it cannot be made."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluation, as far as it has come. Numbers that are missing or infinite are NaN."""

    folder: Path
    experiment: Mapping[str, Any]  # the settings of the evaluation
    # A row per registration with the columns of runners.evaluation.table.RESULTS and `draw`, 0 for
    # the first of several draws of a method.
    rows: pd.DataFrame
    iterations: pd.DataFrame  # the same for moments within registrations
    probes: pd.DataFrame  # a row per probe with the columns of PROBES, of policies

    @property
    def name(self) -> str:
        """The name that the evaluation was given."""
        return str(self.experiment["name"])

    @property
    def definition(self) -> str:
        """The label of the definition of the plausible sets behind all PD."""
        return definition_label(self.experiment["definition"])

    @property
    def definition_text(self) -> str:
        """The same, and which poses are members by it."""
        return definition_text(self.experiment["definition"])

    @cached_property
    def methods(self) -> list[str]:
        """Methods that were asked for, then the others that have a row."""
        asked = [*self.experiment["methods"], *self.experiment["outside"]]
        names = [repeat_of(label, asked)[0] for label in asked]
        return list(dict.fromkeys([*names, *sorted(self.rows["method"].unique())]))

    @cached_property
    def policies(self) -> list[str]:
        """Policies that were asked for, then the others that have a row; none for methods alone."""
        asked = self.experiment["policies"]
        return list(dict.fromkeys([*asked, *sorted(self.probes["policy"].unique())]))

    @cached_property
    def last_half(self) -> pd.DataFrame:
        """The rows of the latter half of the steps of every trial."""
        return last_half(self.rows)

    @cached_property
    def planned_trials(self) -> list[Trial]:
        """Trials that were asked for."""
        names, seeds = self.experiment["configurations"], self.experiment["seeds"]
        return [(name, seed) for name in names for seed in seeds]


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
    """Read the tables of a folder; of an evaluation that has none yet, what is finished."""
    experiment = read_experiment(folder)
    rows, iterations, probes = (_table(folder, experiment, name) for name in TABLES)
    rows, iterations = _with_draws(rows, experiment), _with_draws(iterations, experiment)
    return Evaluation(folder, experiment, rows, iterations, probes)


def _table(folder: Path, experiment: Mapping[str, Any], name: str) -> pd.DataFrame:
    """The rows of a table, sorted; none of a kind that the evaluation does not have."""
    path, schema = folder / f"{name}.parquet", TABLES[name]
    if bool(experiment["policies"]) != (name == "probes"):
        rows = schema.empty_table().to_pandas()
    elif not path.exists():
        rows = gathered(folder, experiment, name).to_pandas()
    else:
        try:
            rows = pd.read_parquet(path, partitioning=None)
        except (pa.ArrowException, ValueError, OSError) as error:
            reason = " ".join(str(error).split())
            raise ReportError(f"{path} cannot be read ({reason}); {_ACCEPTED}") from None
    rows = rows.reindex(columns=schema.names)
    integers = [field.name for field in schema if pa.types.is_integer(field.type)]
    rows = rows.astype(dict.fromkeys(integers, "Int64"))
    numbers = rows[[field.name for field in schema if pa.types.is_floating(field.type)]]
    numbers = numbers.astype(float)
    rows[numbers.columns] = numbers.where(numbers.abs() < math.inf)
    keys = ("object", *TRIAL, "method", "policy", "step", "iteration")
    by = [key for key in keys if key in schema.names]
    rows = rows.sort_values(by, kind="stable", na_position="first", ignore_index=True)
    return rows.astype({"seed": int})


def _with_draws(rows: pd.DataFrame, experiment: Mapping[str, Any]) -> pd.DataFrame:
    """The rows with the label of their method and their draw apart."""
    labels = {*rows["method"], *experiment["methods"], *experiment["outside"]}
    names = rows["method"].unique()
    draws = pd.DataFrame([repeat_of(name, labels) for name in names], names, ["method", "draw"])
    found = draws.reindex(rows["method"])
    return rows.assign(method=found["method"].to_numpy(), draw=found["draw"].to_numpy())
