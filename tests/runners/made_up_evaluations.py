"""Folders of evaluations with made-up numbers, as runners.evaluate leaves them."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet

from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.settings import settings_mapping
from runners.evaluation.experiment import ITERATIONS, PROBES, RESULTS
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.sections import sections_of

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
Row = dict[str, Any]
DEFINITION = {
    "name": "default",
    **settings_mapping(plausible_settings("default", 1.0)),
    "epsilon": None,
}


def row(configuration, seed, *, method, step, **numbers):
    """A registration that has gone well; numbers: by the names of the columns."""
    found = {"object": configuration.split("_")[0], "configuration": configuration, "seed": seed}
    return {**found, "method": method, "preset": "default", "step": step, "status": "ok", **numbers}


def write_evaluation(folder, rows, *, iterations=None, **experiment):
    """A folder with these tables; None: without the table."""
    folder.mkdir(parents=True, exist_ok=True)
    described = {
        "name": "made_up",
        "preset": "default",
        "session": {"kind": "kinematic"},
        "definition": DEFINITION,
        "methods": {},
        "outside": {},
        "policies": {},
        "configurations": list(dict.fromkeys(one["configuration"] for one in rows or ())),
        "seeds": sorted({one["seed"] for one in rows or ()}),
        "commands": ["python -m runners.evaluate experiment=made_up"],
        "environments": [{"python": "3.11", "package numpy": "2.4"}],
        **experiment,
    }
    (folder / "experiment.json").write_text(json.dumps(described))
    for name, some, schema in (("results", rows, RESULTS), ("iterations", iterations, ITERATIONS)):
        if some is not None:
            write_table(folder / f"{name}.parquet", some, schema=schema)
    return folder


def write_table(path, rows, *, schema=RESULTS):
    """Rows as a table; what they do not have is null."""
    pa.parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), path)


def tables_of(folder, baseline=None):
    """The tables of a report by their titles, with their headers, without what is bold."""
    sections = sections_of(open_evaluation(folder), baseline)
    return {
        table.title: [
            [cell.replace("**", "") for cell in row] for row in (table.header, *table.rows)
        ]
        for section in sections
        for table in section.tables
    }


def session(configuration, seed, *, policy, errors, **columns):
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


def write_sessions(folder, rows, *, budgets):
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
    write_table(folder / "probes.parquet", rows, schema=PROBES)
    return folder
