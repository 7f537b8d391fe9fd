"""Folders of evaluations of policies with made-up numbers, as runners.evaluate leaves them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from runners.evaluation.table import PROBES
from tests.runners.made_up_evaluations import write_evaluation, write_table

Row = dict[str, Any]


def session(
    configuration: str, seed: int, policy: str, errors: Sequence[float], **columns: Sequence[Any]
) -> list[Row]:
    """A row per probe. errors: millimetres. columns: further ones, a value for each probe."""
    about = {"object": configuration.split("_")[0], "configuration": configuration, "seed": seed}
    about |= {"policy": policy, "method": "anchored", "preset": "default", "faults": "clean"}
    return [
        {
            **about,
            "step": index,
            "probes": index + 1,
            "status": "ok",
            "contacts": index,
            "error": 1e-3 * error,
            "belief_error": 1e-3 * error,
            "spread": 1e-3 * error,
            "stop": "",
            **{name: values[index] for name, values in columns.items()},
        }
        for index, error in enumerate(errors)
    ]


def write_sessions(folder: Path, rows: Sequence[Row], budgets: Mapping[str, int | None]) -> Path:
    """A folder with these rows. budgets: probes of a session, by policy."""
    policies = {
        name: {"name": name, "settings": {"probes": probes}} for name, probes in budgets.items()
    }
    trials = {name: sorted({row[name] for row in rows}) for name in ("configuration", "seed")}
    write_evaluation(
        folder,
        None,
        policies=policies,
        steered=True,
        methods={"anchored": {"name": "anchored"}},
        configurations=trials["configuration"],
        seeds=trials["seed"],
    )
    write_table(folder / "probes.parquet", rows, PROBES)
    return folder
