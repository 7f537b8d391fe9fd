"""The files of an evaluation: its settings, and its tables as pandas data frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from runners.evaluation.contenders import repeat_of
from runners.evaluation.experiment import TABLES, gathered, read_experiment
from runners.evaluation.metrics import definition_text

TRIAL = ["configuration", "seed"]  # the columns that tell trials apart
Trial = tuple[str, int]  # name of the configuration, and seed


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluation, as far as it has come. Numbers that are missing or infinite are NaN."""

    folder: Path
    experiment: Mapping[str, Any]  # the settings of the evaluation
    rows: pd.DataFrame  # the columns of RESULTS, and `draw`, 0 for a method's first
    iterations: pd.DataFrame  # the same for moments within registrations
    probes: pd.DataFrame  # a row per probe with the columns of PROBES, of policies

    @property
    def definition_text(self) -> str:
        """The definition of the plausible sets behind all PD, and which poses are members by it."""
        return definition_text(self.experiment["definition"])

    @cached_property
    def methods(self) -> list[str]:
        """Methods that were asked for, then the others that have a row."""
        asked = [*self.experiment["methods"], *self.experiment["outside"]]
        names = [repeat_of(label, asked)[0] for label in asked]
        return list(dict.fromkeys([*names, *sorted(self.rows["method"].unique())]))

    @cached_property
    def planned_trials(self) -> list[Trial]:
        """Trials that were asked for."""
        return list(product(self.experiment["configurations"], self.experiment["seeds"]))


def trials_of(rows: pd.DataFrame) -> set[Trial]:
    """Return the trials that have rows."""
    return set(rows[TRIAL].itertuples(index=False, name=None))


def last_half(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the latter half of every trial's steps, which are those of all methods."""
    with_step = rows[rows["step"].notna()]
    first = with_step.groupby(TRIAL)["step"].transform(
        lambda steps: sorted(steps.unique())[steps.nunique() // 2]
    )
    return with_step[with_step["step"] >= first]


def open_evaluation(folder: Path) -> Evaluation:
    """Read the tables of a folder; of an evaluation that has none yet, what is finished."""
    experiment = read_experiment(folder)
    rows, iterations, probes = (_table(folder, experiment, name=name) for name in TABLES)
    rows, iterations = _with_draws(rows, experiment), _with_draws(iterations, experiment)
    return Evaluation(folder, experiment, rows=rows, iterations=iterations, probes=probes)


def _table(folder: Path, experiment: Mapping[str, Any], *, name: str) -> pd.DataFrame:
    """Return the rows of a table; none of a kind that the evaluation does not have."""
    path = folder / f"{name}.parquet"
    table = TABLES[name].empty_table()
    if bool(experiment["policies"]) == (name == "probes"):
        there = path.exists()
        table = (
            parquet.read_table(path, partitioning=None)
            if there
            else gathered(folder, experiment, name=name)
        )
        # Older tables do not have all columns.
        table = pa.concat_tables([TABLES[name].empty_table(), table], promote_options="default")
    rows = table.to_pandas(types_mapper={pa.int64(): pd.Int64Dtype()}.get)
    numbers = rows.select_dtypes("float64")
    rows[numbers.columns] = numbers.where(numbers.abs() < math.inf)
    return rows.astype({"seed": int})


def _with_draws(rows: pd.DataFrame, experiment: Mapping[str, Any]) -> pd.DataFrame:
    """Return the rows with the label of their method and their draw apart."""
    labels = {*rows["method"], *experiment["methods"], *experiment["outside"]}
    apart = rows["method"].map(lambda label: repeat_of(label, labels))
    return rows.assign(method=apart.str[0], draw=apart.str[1])
