"""The true poses that were sought for sessions of recorded sensors, by configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees

import numpy as np

from runners.evaluation.true_poses import FoundPose, true_poses
from runners.reporting.evaluation_folder import Evaluation
from runners.reporting.section import Cell, Section, Table

_MM = 1000.0
Number = Callable[[FoundPose], float | None]
_COLUMNS: tuple[tuple[str, Number], ...] = (
    ("mean |SDF| of contacts, mm", lambda one: _MM * one.mean_distance),
    ("free points inside", lambda one: float(one.violations)),
    ("from the guess, mm", lambda one: _MM * one.moved),
    ("from the guess, degrees", lambda one: degrees(one.turned)),
    ("from the simulated truth, mm", lambda one: _scaled(one.position_error, _MM)),
    ("from the simulated truth, degrees", lambda one: _scaled(one.rotation_error, degrees(1.0))),
)


def true_pose_sections(evaluation: Evaluation) -> list[Section]:
    """A section with a line a configuration; none where true poses were known."""
    found = true_poses(evaluation.folder, evaluation.experiment)
    if not found:
        return []
    text = (
        "The true pose of a recorded session is not known: it is the one of least evaluation cost "
        "near a pose that a person set (or, of a simulated log, its truth as roughly as a person "
        "would set it), by all that is known after the last probe. Plausible sets are made around "
        "it."
    )
    names = dict.fromkeys(one.configuration for one in found)
    rows = [_line(name, [one for one in found if one.configuration == name]) for name in names]
    rows += [_line("all", found)] if len(names) > 1 else []
    header = ("configuration", "trials", *(name for name, _ in _COLUMNS))
    note = (
        "Means over trials, and the greatest in brackets. Distances and angles between poses are "
        "modulo the object's symmetries, at its centre."
    )
    table = Table("True poses found", header, tuple(rows), note=note)
    return [Section("true-poses", "True poses", text, tables=(table,))]


def _line(name: str, found: Sequence[FoundPose]) -> tuple[Cell, ...]:
    cells = [Cell(name), Cell(str(len(found)))]
    for _, number in _COLUMNS:
        values = [value for one in found if (value := number(one)) is not None]
        between = f"[{max(values):.3g}]" if values else ""
        cells.append(Cell(f"{np.mean(values):.3g}" if values else "-", between=between))
    return tuple(cells)


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value
