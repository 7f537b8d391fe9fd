"""The sections of a report, in their order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from runners.reporting import diversity
from runners.reporting.against_baseline import against_baseline
from runners.reporting.by_faults import by_faults
from runners.reporting.calibration import calibration
from runners.reporting.completeness import completeness
from runners.reporting.cost_gradients import cost_gradients
from runners.reporting.over_iterations import over_iterations
from runners.reporting.probing_sequence import probing_sequence
from runners.reporting.registration_times import registration_times
from runners.reporting.section import Section, Subject
from runners.reporting.true_pose_table import true_poses

SECTIONS: tuple[Callable[[Subject], Section | None], ...] = (
    completeness,
    true_poses,
    by_faults,
    against_baseline,
    diversity.over_probes,
    diversity.boxes,
    registration_times,
    over_iterations,
    diversity.of_medial_constraint,
    diversity.of_cvo,
    cost_gradients,
    probing_sequence,
    calibration,
)
"""What makes each section; None where an evaluation has nothing to show in it."""


def sections_of(subject: Subject) -> list[Section]:
    """The sections without empty tables; a picture that cannot be drawn says why."""
    found = [section for make in SECTIONS if (section := make(subject)) is not None]
    return [
        replace(section, tables=tuple(table for table in section.tables if table.rows))
        for section in found
    ]
