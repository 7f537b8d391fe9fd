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
from runners.reporting.decision_times import decision_times
from runners.reporting.error_over_probes import error_over_probes
from runners.reporting.forecast_calibration import forecast_calibration
from runners.reporting.over_iterations import over_iterations
from runners.reporting.policies_compared import policies_compared
from runners.reporting.probes_needed import probes_needed
from runners.reporting.probing_sequence import probing_sequence
from runners.reporting.registration_times import registration_times
from runners.reporting.section import Section, Styles, Subject
from runners.reporting.steered_completeness import steered_completeness
from runners.reporting.steered_sessions import SteeredSessions
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


STEERED: tuple[Callable[[SteeredSessions, Styles], Section | None], ...] = (
    error_over_probes,
    probes_needed,
    policies_compared,
    forecast_calibration,
    decision_times,
)
"""The same of an evaluation of policies, after what was run."""


def sections_of(subject: Subject) -> list[Section]:
    """The sections without empty tables; a picture that cannot be drawn says why."""
    if subject.evaluation.is_steered:
        found = _of_policies(subject)
    else:
        found = [section for make in SECTIONS if (section := make(subject)) is not None]
    return [
        replace(section, tables=tuple(table for table in section.tables if table.rows))
        for section in found
    ]


def _of_policies(subject: Subject) -> list[Section]:
    sessions, styles = subject.sessions, subject.policy_styles
    made = [make(sessions, styles) for make in STEERED]
    first = steered_completeness(subject.evaluation, sessions, styles)
    return [first, *(section for section in made if section is not None)]
