"""All finished parts of an evaluation as its two tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from runners.evaluation.claims import claimed
from runners.evaluation.definition import definition_label
from runners.evaluation.experiment import read_experiment
from runners.evaluation.table import (
    ITERATIONS,
    ITERATIONS_ORDER,
    RESULTS,
    RESULTS_ORDER,
    write_table,
)


def gather(folder: Path) -> pa.Table:
    """Write results and, where iterations are measured, iterations; the former.

    Every part that exists is in them, whoever made it and when.
    """
    with claimed(folder, "tables", wait=True):
        experiment = read_experiment(folder)
        definition = definition_label(experiment["definition"])
        if experiment["iterations"]["every"] is not None:
            parts = list(_parts(folder, experiment, ".iterations.parquet"))
            write_table(folder, "iterations", parts, ITERATIONS, ITERATIONS_ORDER, definition)
        parts = list(_parts(folder, experiment, ".parquet", ".failed.parquet"))
        return write_table(folder, "results", parts, RESULTS, RESULTS_ORDER, definition)


def _parts(folder: Path, experiment: Mapping[str, Any], *suffixes: str) -> Iterable[Path]:
    """Of every trial and label the first file with one of the suffixes."""
    labels = [*experiment["methods"], *experiment["outside"]]
    for configuration in experiment["configurations"]:
        for seed in experiment["seeds"]:
            trial = folder / "trials" / configuration / f"seed_{seed}"
            for label in labels:
                files = (trial / f"{label}{suffix}" for suffix in suffixes)
                yield from [file for file in files if file.exists()][:1]
