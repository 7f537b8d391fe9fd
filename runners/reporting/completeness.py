"""How much of an evaluation is there: which of the planned trials, and what went wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from runners.evaluation.repeats import repeat_of
from runners.reporting.evaluation_folder import Evaluation, Trial, asked_labels, named
from runners.reporting.method_style import MethodStyle
from runners.reporting.section import Cell, Table
from runners.reporting.statistics import grouped, trial_of

_MOST_LISTED = 60
_OK, _FAILED = "ok", "failed"
Styles = Mapping[str, MethodStyle]
_Reason = tuple[str, str, str]
"""Configuration, steps, and why these are not there."""


def planned_trials(evaluation: Evaluation) -> list[Trial]:
    """Configurations with seeds that were asked for; those that are there, if it is not told."""
    configurations = named(evaluation.experiment.get("configurations"))
    seeds = evaluation.experiment.get("seeds")
    if not configurations or not isinstance(seeds, list):
        return sorted({trial_of(row) for row in evaluation.rows})
    return [(name, seed) for name in configurations for seed in seeds]


def planned_methods(evaluation: Evaluation) -> list[str]:
    """Labels that were asked for, then those that are there besides."""
    asked = asked_labels(evaluation.experiment)
    without_draws = [repeat_of(label, asked)[0] for label in asked]
    return list(dict.fromkeys([*without_draws, *evaluation.methods]))


def completeness_table(evaluation: Evaluation, styles: Styles) -> Table:
    """How many trials and steps of every method are there."""
    planned = set(planned_trials(evaluation))
    by_method = grouped(evaluation.rows, lambda row: row["method"])
    lines = []
    for method, style in styles.items():
        rows = by_method.get(method, [])
        done = {trial_of(row) for row in rows if not _failed(row)}
        failed = {trial_of(row) for row in rows} - done
        counts = (
            f"{len(done)} of {len(planned | done)}",
            len(failed),
            len(planned - done - failed),
            sum(not _failed(row) for row in rows),
            sum(_failed(row) for row in rows),
            sum(not _failed(row) and row["diversity"] is None for row in rows),
        )
        lines.append((Cell(style.title), *(Cell(str(count)) for count in counts)))
    header = (
        "method",
        "trials done",
        "trials failed",
        "trials missing",
        "registrations",
        "registrations failed",
        "registrations without PD",
    )
    return Table("What is there", header, tuple(lines))


def objects_table(evaluation: Evaluation) -> Table:
    """Configurations, seeds and steps of every object."""
    lines = []
    for name, rows in grouped(evaluation.rows, lambda row: row["object"]).items():
        configurations = sorted({row["configuration"] for row in rows})
        trials = {trial_of(row) for row in rows}
        steps = {(*trial_of(row), row["step"]) for row in rows if row["step"] is not None}
        with_set = {(*trial_of(row), row["step"]) for row in rows if row.get("members") is not None}
        texts = (", ".join(configurations), len(trials), len(steps), len(with_set))
        lines.append((Cell(name), *(Cell(str(text)) for text in texts)))
    header = ("object", "configurations", "trials", "steps", "steps with a plausible set")
    return Table("Objects", header, tuple(lines), labels=2)


def failures_table(evaluation: Evaluation) -> Table:
    """What failed, and what is not there: a line for all that are alike in a configuration."""
    reasons: dict[_Reason, dict[str, set[int]]] = {}  # to the seeds of every method

    def note(trial: Trial, method: str, steps: str, why: str) -> None:
        seeds = reasons.setdefault((trial[0], steps, why), {})
        seeds.setdefault(method, set()).add(trial[1])

    by_unit = grouped(evaluation.rows, lambda row: (trial_of(row), row["method"]))
    for (trial, method), rows in by_unit.items():
        for status, some in grouped(rows, lambda row: row["status"]).items():
            if status != _OK:
                steps = [row["step"] for row in some if row["step"] is not None]
                note(trial, method, _ranges(steps) or "all", status)
    methods = planned_methods(evaluation)
    for trial in planned_trials(evaluation):
        for method in methods:
            if (trial, method) not in by_unit:
                note(trial, method, "all", "not there")
    lines = [line for reason, seeds in reasons.items() for line in _lines(reason, seeds, methods)]
    rest = len(lines) - _MOST_LISTED
    return Table(
        "What is missing",
        ("configuration", "seeds", "methods", "steps", "why"),
        tuple(lines[:_MOST_LISTED]),
        labels=5,
        note=f"and {rest} lines more" if rest > 0 else "",
    )


def _lines(
    reason: _Reason, seeds: Mapping[str, set[int]], methods: Sequence[str]
) -> Iterator[tuple[Cell, ...]]:
    """A line for all methods that miss the same seeds."""
    configuration, steps, why = reason
    alike: dict[str, list[str]] = {}
    for method, some in seeds.items():
        alike.setdefault(_ranges(some), []).append(method)
    for which, some_methods in alike.items():
        names = "all" if len(some_methods) == len(methods) > 1 else ", ".join(some_methods)
        yield tuple(Cell(text) for text in (configuration, which, names, steps, why))


def _failed(row: Mapping[str, Any]) -> bool:
    return str(row["status"]).startswith(_FAILED)


def _ranges(numbers: Iterable[int]) -> str:
    """Numbers in short, such as "3, 5..8"."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{r[0]}..{r[-1]}" if len(r) > 1 else str(r[0]) for r in runs)
