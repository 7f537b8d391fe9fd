"""The numbers of a comparison as a tidy CSV file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
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
    rows = []
    for outcome in outcomes:
        method, numbers = by_label.get(outcome.label), outcome.numbers
        rows.append(
            {
                "step": outcome.step,
                "label": outcome.label,
                "method": method.named.name if method else outcome.label.split(": ", 1)[-1],
                "changes": "; ".join(method.changes) if method else "",
                "cost": cost.name,
                "definition": definition if "diversity" in numbers else "",
                **{column.csv_name: numbers.get(column.name) for column in COLUMNS},
                "bits_as_recorded": {True: "yes", False: "no", None: ""}[outcome.as_recorded],
                "failure": outcome.failure,
            }
        )
    with new_file(path) as beside, beside.open("x", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
