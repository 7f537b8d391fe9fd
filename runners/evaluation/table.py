"""The table of an evaluation: its columns, its finished parts, and both put together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from chsel.errors import RecordingError
from replay.files import whole_file

Row = Mapping[str, Any]

DEFINITION = "definition"
"""The column with the label of the definition of the plausible sets behind a row's numbers."""
FAULTS = "faults"
"""The column with the level of faults in a row's session."""
_KEYS = [("object", pa.string()), ("configuration", pa.string()), ("seed", pa.int64())]
_KEYS += [("method", pa.string())]
_INTEGERS = ("contacts", "free_points", "occupied_points")
_TRUTH = ("nearest_hypothesis", "nearest_position", "nearest_rotation")
_METRICS = ("coverage", "plausibility", "diversity", "root")
RESULTS = pa.schema(
    [
        *_KEYS,
        ("preset", pa.string()),
        (DEFINITION, pa.string()),
        (FAULTS, pa.string()),
        ("step", pa.int64()),
        *((name, pa.int64()) for name in _INTEGERS),
        ("status", pa.string()),
        *((name, pa.int64()) for name in ("members", "kept", "local")),
        ("true_cost", pa.float64()),
        *((name, pa.int64()) for name in ("hypotheses", "distinct")),
        *((name, pa.float64()) for name in ("best_cost", "mean_cost", *_METRICS)),
        *((name, pa.float64()) for name in ("position_error", "rotation_error", "rank")),
        ("truth_held", pa.bool_()),
        *((name, pa.float64()) for name in (*_TRUTH, "exact_members", "seconds")),
        ("digest", pa.string()),
        ("problem_digest", pa.string()),
    ]
)
"""A row a (configuration, seed, method, step). Lengths in metres, angles in radians, but coverage,
plausibility and diversity (PD) in mm^2 and root, of PD, in mm. position_error, rotation_error: of
the best hypothesis, modulo the object's symmetries, at its centre. nearest_hypothesis: root mean
square distance of the true pose's surface from that of the nearest hypothesis, whose errors are
nearest_position and nearest_rotation. truth_held: whether the true pose lies in the set that the
result stands for, where a method tells. faults: the level of the session's. status: "ok", "failed:
REASON" or "no plausible set: REASON"; what a row does not have is null."""
ITERATIONS = pa.schema(
    [
        *_KEYS[1:],
        (DEFINITION, pa.string()),
        ("step", pa.int64()),
        ("iteration", pa.int64()),
        ("filled", pa.int64()),
        *((name, pa.float64()) for name in ("best_cost", "mean_cost", "qd_score", *_METRICS)),
    ]
)
"""A row a (configuration, seed, method, step, iteration) of a search over an archive. Costs and
metrics are of the hypotheses that the method would give if it ended there."""
_FORECAST = ("hit_forecast", "forecast_spread")
_DECISION = ("surprise", "seconds", "decision_seconds")
PROBES = pa.schema(
    [
        *_KEYS[:3],
        ("policy", pa.string()),
        ("method", pa.string()),
        ("preset", pa.string()),
        (FAULTS, pa.string()),
        ("step", pa.int64()),
        ("probes", pa.int64()),
        ("status", pa.string()),
        *((name, pa.int64()) for name in ("contacts", "free_points", "action")),
        ("hit", pa.bool_()),
        *((name, pa.float64()) for name in (*_FORECAST, *_DECISION)),
        *((name, pa.int64()) for name in ("hypotheses", "poses")),
        *((name, pa.float64()) for name in ("error", "belief_error", "spread", "promised")),
        ("stop", pa.string()),
        *((name, pa.string()) for name in ("digest", "problem_digest", "decision_digest")),
    ]
)
"""A row a (configuration, seed, policy, probe). Lengths in metres, surprise in nats. probes: how
many are done. action: index of the one that was taken, of those offered. hit: whether it met the
object; hit_forecast: the chance of it; forecast_spread: how wide the belief was expected to be
after it. error: mean distance of the surface in a hypothesis from that in the true pose, of the
last registration; before there is one, belief_error, which is the same of the belief's poses by
their weights. poses: how many these are. spread: of the belief. promised: by how much the best
action would narrow it. stop: why a session with the usual rules would end here, "" if it goes on.
seconds: of the registration. decision_seconds: of choosing what comes next. status: "ok" or
"failed: REASON"; what a row does not have is null."""
TABLES = {"results": RESULTS, "iterations": ITERATIONS, "probes": PROBES}
_ORDER = ("object", "configuration", "seed", "policy", "method", "step", "iteration")


def write_part(path: Path, rows: Sequence[Row], schema: pa.Schema, source: str = "") -> None:
    """Write a finished part of a table. source: kept with it, see `part_source`."""
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=schema)
    with whole_file(path) as beside:
        pa.parquet.write_table(table.replace_schema_metadata({"about": source}), beside)


def read_part(path: Path, schema: pa.Schema, definition: str) -> pa.Table:
    """A part. Raises RecordingError if it is damaged, of another version or definition.

    definition: label of that of the evaluation.
    """
    try:
        table = pa.parquet.read_table(path).replace_schema_metadata().cast(schema)
    except (pa.ArrowException, ValueError, OSError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(
            f"{path} cannot be read ({reason}); remove it to have it made again"
        ) from None
    if DEFINITION in schema.names:
        others = set(table[DEFINITION].to_pylist()) - {definition}
        if others:
            raise RecordingError(
                f"{path} has numbers by the definition {others.pop()} of plausible sets; accepted "
                f"in this folder: {definition}, so remove the file to have it made again"
            )
    return table


def part_source(path: Path) -> str | None:
    """What was kept with a part; None if there is no part that can be read, as its end says."""
    try:
        metadata = pa.parquet.read_schema(path).metadata or {}
    except (pa.ArrowException, ValueError, OSError):
        return None
    return metadata.get(b"about", b"").decode()


def joined_parts(parts: Sequence[Path], schema: pa.Schema, definition: str) -> pa.Table:
    """All rows of parts by one definition, in order."""
    tables = [read_part(path, schema, definition) for path in parts]
    order = [(key, "ascending") for key in _ORDER if key in schema.names]
    return pa.concat_tables([schema.empty_table(), *tables]).sort_by(order).combine_chunks()


def write_table(folder: Path, name: str, table: pa.Table) -> pa.Table:
    """Write NAME.parquet and NAME.csv."""
    with whole_file(folder / f"{name}.parquet") as beside:
        pa.parquet.write_table(table, beside)
    with whole_file(folder / f"{name}.csv") as beside:
        pa.csv.write_csv(table, beside)
    return table
