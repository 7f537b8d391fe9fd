"""Folders of evaluations with made-up numbers, as runners.evaluate leaves them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.settings import settings_mapping
from runners.evaluation.table import ITERATIONS, RESULTS

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
Row = dict[str, Any]
DEFINITION = {
    "name": "default",
    **settings_mapping(plausible_settings("default", 1.0)),
    "epsilon": None,
}
METHODS = {  # PD in mm^2 at the first step, seconds
    "chsel": (300.0, 0.15),
    "chsel_cma_me": (400.0, 0.11),
    "gradient_descent": (700.0, 0.05),
    "icp": (5000.0, 0.01),
    "svgd": (1500.0, 0.2),
    "cvo": (20_000.0, 3.0),
    "cvo_no_free_space": (6000.0, 1.0),
    "medial_constraint": (2500.0, 0.5),
    "medial_constraint_cma_me": (1200.0, 0.7),
}


def row(configuration: str, seed: int, method: str, step: int | None, **numbers: Any) -> Row:
    """A registration that has gone well; numbers: by the names of the columns."""
    found = {"object": configuration.split("_")[0], "configuration": configuration, "seed": seed}
    return {**found, "method": method, "preset": "default", "step": step, "status": "ok", **numbers}


def made_up_rows(
    configurations: Sequence[str], seeds: Sequence[int], steps: int, methods: Iterable[str]
) -> list[Row]:
    """PD that falls with the steps, and spreads."""
    random = np.random.default_rng(0)
    rows = []
    for configuration in configurations:
        for seed in seeds:
            for method in methods:
                first, seconds = METHODS.get(method, (1000.0, 0.1))
                for step in range(4, 4 + steps):
                    diversity = first * 0.9**step * float(random.lognormal(0.0, 0.5))
                    numbers = {
                        "diversity": diversity,
                        "root": diversity**0.5,
                        "seconds": seconds * float(random.lognormal(0.0, 0.3)),
                        "members": 40,
                        "rank": float(random.uniform()),
                        "exact_members": float(random.uniform()),
                    }
                    rows.append(row(configuration, seed, method, step, **numbers))
    return rows


def made_up_iterations(
    configuration: str, seeds: Sequence[int], steps: Sequence[int], methods: Iterable[str]
) -> list[Row]:
    """PD and cost that fall with the iterations."""
    random = np.random.default_rng(1)
    rows = []
    for seed in seeds:
        for method in methods:
            pace = 100.0 if method == "chsel" else 200.0
            for step in steps:
                for iteration in range(0, 1001, 25):
                    left = float(np.exp(-iteration / pace)) + 0.05
                    found: Row = {"configuration": configuration, "seed": seed, "method": method}
                    found |= {"step": step, "iteration": iteration}
                    found |= {"diversity": 500.0 * left * float(random.lognormal(0.0, 0.2))}
                    found |= {"mean_cost": 0.5 * left * float(random.lognormal(0.0, 0.1))}
                    rows.append(found)
    return rows


def write_evaluation(
    folder: Path,
    rows: Sequence[Row] | None,
    iterations: Sequence[Row] | None = None,
    **experiment: Any,
) -> Path:
    """A folder with these tables; None: without the table."""
    folder.mkdir(parents=True, exist_ok=True)
    described = {
        "name": "made_up",
        "preset": "default",
        "session": {"kind": "kinematic"},
        "definition": DEFINITION,
        "commands": ["python -m runners.evaluate experiment=made_up"],
        "environment": {"python": "3.11", "package numpy": "2.4"},
        **experiment,
    }
    (folder / "experiment.json").write_text(json.dumps(described))
    for name, some, schema in (("results", rows, RESULTS), ("iterations", iterations, ITERATIONS)):
        if some is not None:
            write_table(folder / f"{name}.parquet", some, schema)
    return folder


def write_table(path: Path, rows: Sequence[Row], schema: pa.Schema | None = RESULTS) -> None:
    """Rows as a table; what they do not have is null."""
    pa.parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), path)


def add_recording(folder: Path, configuration: str, seed: int, method: str, replay: str) -> None:
    """A stored replay as the recording of a trial."""
    target = folder / "trials" / configuration / f"seed_{seed}" / f"{method}.mcap"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(REPLAYS / f"{replay}.mcap", target)
