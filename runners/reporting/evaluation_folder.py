"""What an evaluation has left in its folder: its settings, its tables, its recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet

from chsel.errors import ChselError
from runners.evaluation.definition import definition_label, definition_text
from runners.evaluation.repeats import repeat_of

EXPERIMENT = "experiment.json"
RESULTS = "results.parquet"
ITERATIONS = "iterations.parquet"
_ACCEPTED = "accepted: a folder that runners.evaluate has written"
_NEEDED = {
    RESULTS: ("object", "configuration", "seed", "method", "step", "status", "diversity"),
    ITERATIONS: ("configuration", "seed", "method", "step", "iteration", "diversity"),
}
_KEYS = ("object", "configuration", "seed", "method", "status")
_UNNAMED = "an unnamed definition"
Row = Mapping[str, Any]
Trial = tuple[str, int]
"""Name of the configuration, and seed."""


class ReportError(ChselError):
    """A folder is no evaluation, or a report on it cannot be made."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluation, as far as it has come.

    experiment: how it was asked for, plain values. rows: a mapping of every registration, None
    where there is no finite number; sorted by object, configuration, seed, method, step, draw.
    Draws of a method are told apart by their `draw` alone, 0 for the first. iterations: the same
    of moments within registrations. gathered: whether the rows come from finished parts, as there
    is no table of all yet. definition: label of that of the plausible sets behind all PD.
    """

    folder: Path
    experiment: Mapping[str, Any]
    rows: Sequence[Row]
    iterations: Sequence[Row]
    gathered: bool = False
    definition: str = ""

    @property
    def definition_text(self) -> str:
        """The definition of the plausible sets, and which poses are members by it."""
        asked = self.experiment.get("definition")
        if isinstance(asked, Mapping) and _label(asked) == self.definition:
            with suppress(ChselError):  # of another version of this package
                return definition_text(asked)
        return self.definition

    @cached_property
    def objects(self) -> list[str]:
        """Those with a row."""
        return sorted({row["object"] for row in self.rows})

    @cached_property
    def methods(self) -> list[str]:
        """Those with a row."""
        return sorted({row["method"] for row in self.rows})

    @cached_property
    def object_of(self) -> dict[str, str]:
        """Objects by configuration."""
        return {row["configuration"]: row["object"] for row in self.rows}

    def trial_folder(self, trial: Trial) -> Path:
        """Where the recordings of a trial are."""
        configuration, seed = trial
        return self.folder / "trials" / configuration / f"seed_{seed}"

    def recording(self, trial: Trial, method: str) -> Path | None:
        """The recording of a method in a trial, if there is one."""
        path = self.trial_folder(trial) / f"{method}.mcap"
        return path if path.is_file() else None


def open_evaluation(folder: Path) -> Evaluation:
    """Read the tables of a folder. Raises ReportError unless it is one of an evaluation."""
    if not folder.is_dir():
        raise ReportError(f"folder {folder} does not exist; {_ACCEPTED}")
    experiment = _experiment(folder / EXPERIMENT)
    rows, gathered = _table(folder, RESULTS, "trials/*/seed_*/*.parquet")
    iterations, _ = _table(folder, ITERATIONS, "trials/*/seed_*/*.iterations.parquet")
    labels = {str(row["method"]) for row in rows} | set(asked_labels(experiment))
    for row in [*rows, *iterations]:
        row["method"], row["draw"] = repeat_of(row["method"], labels)
    order = ("object", "configuration", "seed", "method", "step")
    rows.sort(key=lambda row: [_sortable(row[name]) for name in (*order, "draw")])
    moments = (*order[1:], "iteration", "draw")
    iterations.sort(key=lambda row: [_sortable(row[name]) for name in moments])
    definition = _definition(folder, experiment, [*rows, *iterations])
    return Evaluation(folder, experiment, rows, iterations, gathered, definition)


def _definition(folder: Path, experiment: Mapping[str, Any], rows: Sequence[Row]) -> str:
    """The label of the one definition of plausible sets by which all rows were measured.

    Rows from before there was a column of it have that of experiment.json. Raises ReportError if
    there are several: medians over numbers by different definitions mean nothing.
    """
    asked = experiment.get("definition")
    ours = _label(asked) if isinstance(asked, Mapping) else _UNNAMED
    labels = sorted({str(row.get("definition") or ours) for row in rows})
    if len(labels) > 1:
        raise ReportError(
            f"{folder} has numbers by {len(labels)} definitions of plausible sets, "
            f"{', '.join(labels)}; accepted: one, so evaluate each into an out=DIR of its own"
        )
    return labels[0] if labels else ours


def _label(definition: Mapping[str, Any]) -> str:
    try:
        return definition_label(definition)
    except ChselError:  # of another version of this package
        return str(definition.get("name") or _UNNAMED)


def asked_labels(experiment: Mapping[str, Any]) -> list[str]:
    """Labels of methods and of sets from outside that were asked for, those of draws too."""
    return [name for kind in ("methods", "outside") for name in named(experiment.get(kind))]


def named(value: Any) -> list[str]:
    """Names in a list, of which some may be mappings with a label or a name, or in a mapping."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        return [str(name) for name in value]
    if not isinstance(value, list):
        return []
    return [
        str(entry.get("label") or entry.get("name")) if isinstance(entry, Mapping) else str(entry)
        for entry in value
    ]


def _experiment(path: Path) -> Mapping[str, Any]:
    try:
        experiment = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ReportError(f"folder {path.parent} has no {path.name}; {_ACCEPTED}") from None
    except (ValueError, OSError) as error:
        raise ReportError(f"{path} cannot be read ({error}); {_ACCEPTED}") from None
    if not isinstance(experiment, Mapping):
        raise ReportError(f"{path} is no mapping of settings; {_ACCEPTED}")
    return experiment


def _table(folder: Path, name: str, parts: str) -> tuple[list[dict[str, Any]], bool]:
    """The rows of a table; without one, those of its parts, and whether that was so."""
    if (folder / name).exists():
        return _rows(folder / name, _NEEDED[name]), False
    found = [
        path
        for path in sorted(folder.glob(parts))
        if name == ITERATIONS or not path.name.endswith(".iterations.parquet")
    ]
    found = [path for path in found if not _done_again(path)]
    return [row for path in found for row in _rows(path, _NEEDED[name])], bool(found)


def _done_again(path: Path) -> bool:
    """Whether a part says how something failed that is there now."""
    name = path.name.removesuffix(".failed.parquet")
    return name != path.name and path.with_name(f"{name}.parquet").exists()


def _sortable(value: Any) -> tuple[bool, Any]:
    """What has no value comes first."""
    return (False, 0) if value is None else (True, value)


def _rows(path: Path, needed: Sequence[str]) -> list[dict[str, Any]]:
    try:
        table = pyarrow.parquet.read_table(path, partitioning=None)
    except (pyarrow.ArrowException, OSError) as error:
        text = " ".join(str(error).split())
        raise ReportError(f"{path} cannot be read as a table ({text}); {_ACCEPTED}") from None
    missing = [name for name in needed if name not in table.column_names]
    if missing:
        raise ReportError(f"{path} lacks the column {', '.join(missing)}; {_ACCEPTED}")
    rows = [{key: _finite(value) for key, value in row.items()} for row in table.to_pylist()]
    for row in rows:
        for key in (key for key in _KEYS if key in needed):
            if row[key] is None:
                raise ReportError(f"{path} has a row without {key}; {_ACCEPTED}")
    return rows


def _finite(value: Any) -> Any:
    """What is not a number has no value."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
