"""The rank of the true pose among the hypotheses, and how many hypotheses are plausible."""

from __future__ import annotations

from runners.reporting.section import LAST_HALF, Section, Subject
from runners.reporting.tables import Best, method_table

_COLUMNS: dict[str, tuple[str, str, Best]] = {  # title, note, and which median is best
    "rank": (
        "Rank of the true pose among the hypotheses",
        "Uniform in (0, 1], so 0.5 in the median, for a set that spreads as far as it errs; small "
        "ones say that the truth is outside of it.",
        None,
    ),
    "exact_members": (
        "Share of hypotheses in the plausible set",
        "Of hypotheses that fulfil the definition of the plausible set themselves, {definition}; 1 "
        "is best.",
        "max",
    ),
}


def calibration(subject: Subject) -> Section | None:
    """A table for each of the numbers, where they were computed."""
    half, definition = subject.evaluation.last_half, subject.evaluation.definition
    tables = tuple(
        method_table(
            title,
            half,
            "object",
            subject.styles,
            column=column,
            best=best,
            note=note.format(definition=definition),
        )
        for column, (title, note, best) in _COLUMNS.items()
        if half[column].notna().any()
    )
    if not tables:
        return None
    return Section("calibration", "Calibration and membership", LAST_HALF, tables=tables)
