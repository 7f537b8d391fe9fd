"""The true poses that were sought for sessions of recorded sensors, by configuration."""

from __future__ import annotations

from math import degrees

import pandas as pd

from runners.evaluation.true_poses import true_poses as found_true_poses
from runners.reporting.section import Section, Subject
from runners.reporting.tables import Cell, Table

_MM, _DEGREES = 1000.0, degrees(1.0)
_COLUMNS = {  # of a FoundPose: heading, factor
    "mean_distance": ("mean |SDF| of contacts, mm", _MM),
    "violations": ("free points inside", 1.0),
    "moved": ("from the guess, mm", _MM),
    "turned": ("from the guess, degrees", _DEGREES),
    "position_error": ("from the simulated truth, mm", _MM),
    "rotation_error": ("from the simulated truth, degrees", _DEGREES),
}


def true_poses(subject: Subject) -> Section | None:
    """A table with a line per configuration; None where true poses were known."""
    evaluation = subject.evaluation
    found = pd.DataFrame(found_true_poses(evaluation.folder, evaluation.experiment))
    if found.empty:
        return None
    text = (
        "The true pose of a recorded session is not known: it is the one of least evaluation cost "
        "near a pose that a person set (or, of a simulated log, its truth as roughly as a person "
        "would set it), by all that is known after the last probe. Plausible sets are made around "
        "it."
    )
    groups = [(str(name), some) for name, some in found.groupby("configuration", sort=False)]
    groups += [("all", found)] if len(groups) > 1 else []
    note = (
        "Means over trials, and the greatest in brackets. Distances and angles between poses are "
        "modulo the object's symmetries, at its centre."
    )
    header = ("configuration", "trials", *(heading for heading, _ in _COLUMNS.values()))
    rows = tuple(_line(name, some) for name, some in groups)
    table = Table("True poses found", header, rows, note=note)
    return Section("true-poses", "True poses", text, tables=(table,))


def _line(name: str, found: pd.DataFrame) -> tuple[Cell, ...]:
    cells = [Cell(name), Cell(str(len(found)))]
    for column, (_, factor) in _COLUMNS.items():
        values = factor * found[column].astype(float).dropna()
        between = "" if values.empty else f"[{values.max():.3g}]"
        cells.append(Cell("-" if values.empty else f"{values.mean():.3g}", between=between))
    return tuple(cells)
