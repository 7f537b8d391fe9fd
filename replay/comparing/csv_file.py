"""The numbers of a comparison as a tidy CSV file."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from replay.comparing.columns import COLUMNS
from replay.comparing.comparison import CommonCost, Outcome
from replay.comparing.contenders import Contender
from replay.files import new_file


def write_csv(
    path: Path,
    outcomes: Sequence[Outcome],
    methods: Sequence[Contender],
    cost: CommonCost,
    definition: str,
) -> None:
    """Write a new file: a row for each step and method; names of columns end in their unit.

    step, label, method, changes (to the settings, with "; " between), cost (by which all are
    judged), definition (of the plausible sets, empty where a row has no PD), then the numbers with
    all digits, empty where there are none, then bits_as_recorded (yes, no, or empty where the
    method is not the recorded one) and failure.
    """
    by_label = {method.label: method for method in methods}
    names = ["step", "label", "method", "changes", "cost", "definition"]
    names += [column.csv_name for column in COLUMNS]
    with new_file(path) as beside, beside.open("x", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*names, "bits_as_recorded", "failure"])
        for outcome in outcomes:
            writer.writerow(
                [
                    outcome.step,
                    outcome.label,
                    *_method(outcome, by_label),
                    cost.name,
                    definition if "diversity" in outcome.numbers else "",
                    *(_exact(outcome, column.name) for column in COLUMNS),
                    {True: "yes", False: "no", None: ""}[outcome.as_recorded],
                    outcome.failure,
                ]
            )


def _method(outcome: Outcome, by_label: Mapping[str, Contender]) -> tuple[str, str]:
    """Name and changes of a method; of the recorded result, what its label says."""
    method = by_label.get(outcome.label)
    if method is None:
        return outcome.label.split(": ", 1)[-1], ""
    return method.named.name, "; ".join(method.changes)


def _exact(outcome: Outcome, name: str) -> str:
    value = outcome.numbers.get(name)
    return "" if value is None else repr(value)
