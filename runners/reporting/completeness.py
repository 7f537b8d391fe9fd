"""How much of an evaluation is there: which of the planned trials, and what went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product

import pandas as pd

from runners.reporting.evaluation_folder import TRIAL, Evaluation, Trial, trials_of
from runners.reporting.section import Section, Styles, Subject
from runners.reporting.statistics import DIVERSITY
from runners.reporting.tables import Cell, Table, table_of

_MOST_LISTED = 60
_OK, _FAILED = "ok", "failed"


def completeness(subject: Subject) -> Section:
    """Counts of what is there, and what is missing."""
    evaluation = subject.evaluation
    text = (
        "A trial is a configuration with a seed. Its steps are the registrations after probes. "
        "What is missing or has failed is nowhere counted as a number."
    )
    tables = (
        completeness_table(evaluation, subject.styles),
        objects_table(evaluation.rows),
        failures_table(evaluation),
    )
    return Section("what-was-run", "What was run", text, tables=tables)


def completeness_table(evaluation: Evaluation, styles: Styles) -> Table:
    """How many trials and steps of every method are there."""
    planned = set(evaluation.planned_trials)
    columns: dict[str, Callable[[_OfMethod], str | int]] = {
        "method": lambda of: of.title,
        "trials done": lambda of: f"{len(of.trials)} of {len(planned | of.trials)}",
        "trials failed": lambda of: len(of.failed_trials),
        "trials missing": lambda of: len(planned - of.trials - of.failed_trials),
        "registrations": lambda of: len(of.rows),
        "registrations failed": lambda of: len(of.failed),
        "registrations without PD": lambda of: of.rows[DIVERSITY].isna().sum(),
    }
    rows = evaluation.rows
    failed = rows["status"].str.startswith(_FAILED)
    methods = [
        _OfMethod(style.title, rows[own & ~failed], rows[own & failed])
        for style, own in ((style, rows["method"] == method) for method, style in styles.items())
    ]
    return table_of("What is there", columns, methods)


@dataclass(frozen=True)
class _OfMethod:
    """What there is of a method."""

    title: str
    rows: pd.DataFrame
    failed: pd.DataFrame  # the rows that say why there is none

    @property
    def trials(self) -> set[Trial]:
        """Trials with a result."""
        return trials_of(self.rows)

    @property
    def failed_trials(self) -> set[Trial]:
        """Trials without a result, of which a row says why."""
        return trials_of(self.failed) - self.trials


def objects_table(rows: pd.DataFrame) -> Table:
    """Configurations, seeds and steps of every object."""
    place = [*TRIAL, "step"]
    columns: dict[str, Callable[[tuple[str, pd.DataFrame]], str | int]] = {
        "object": lambda of: of[0],
        "configurations": lambda of: ", ".join(sorted(of[1]["configuration"].unique())),
        "trials": lambda of: len(trials_of(of[1])),
        "steps": lambda of: len(of[1][of[1]["step"].notna()].drop_duplicates(place)),
        "steps with a plausible set": lambda of: len(
            of[1][of[1]["members"].notna()].drop_duplicates(place)
        ),
    }
    return table_of("Objects", columns, rows.groupby("object"), labels=2)


def failures_table(evaluation: Evaluation) -> Table:
    """What failed, and what is not there: a line for all that are alike in a configuration."""
    rows, methods = evaluation.rows, evaluation.planned_methods
    groups = rows[rows["status"] != _OK].groupby([*TRIAL, "method", "status"], sort=False)["step"]
    failed = groups.agg(lambda steps: _ranges(steps.dropna()) or "all")
    present = set(rows[[*TRIAL, "method"]].itertuples(index=False, name=None))
    absent = [
        (*trial, method, "not there", "all")
        for trial, method in product(evaluation.planned_trials, methods)
        if (*trial, method) not in present
    ]
    found = [*failed.reset_index().itertuples(index=False, name=None), *absent]
    missing = pd.DataFrame(found, columns=[*TRIAL, "method", "status", "step"])
    reason = ["configuration", "step", "status"]
    lines = []
    for (configuration, steps, why), alike in missing.groupby(reason, sort=False):
        seeds = alike.groupby("method", sort=False)["seed"].agg(_ranges)
        for which, some in seeds.groupby(seeds, sort=False):
            every = len(some) == len(methods) > 1
            names = "all" if every else ", ".join(some.index)
            texts = map(str, (configuration, which, names, steps, why))
            lines.append(tuple(map(Cell, texts)))
    rest = len(lines) - _MOST_LISTED
    return Table(
        "What is missing",
        ("configuration", "seeds", "methods", "steps", "why"),
        tuple(lines[:_MOST_LISTED]),
        labels=5,
        note=f"and {rest} lines more" if rest > 0 else "",
    )


def _ranges(numbers: Iterable[int]) -> str:
    """Numbers in short, such as "3, 5..8"."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{r[0]}..{r[-1]}" if len(r) > 1 else str(r[0]) for r in runs)
