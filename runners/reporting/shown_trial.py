"""Which trial the pictures of a single one show."""

from __future__ import annotations

import re

from runners.reporting.evaluation_folder import Evaluation, ReportError, Trial
from runners.reporting.section import NotDrawn
from runners.reporting.statistics import grouped, last_half, spread, trial_of
from runners.reporting.tables import DIVERSITY

_PREFERRED = "drill"  # the object of the paper's pictures
_METHOD = "chsel"


def named_trial(text: str) -> Trial:
    """A trial such as "drill/0" or "drill/seed_0"; ReportError for another text."""
    match = re.fullmatch(r"([^/]+)/(?:seed_)?(\d{1,19})", text)
    if match is None:
        raise ReportError(f"trial is {text!r}; accepted: CONFIGURATION/SEED, such as drill/0")
    return match[1], int(match[2])


def usual_trial(evaluation: Evaluation) -> tuple[Trial, str]:
    """The recorded trial of the median PD of CHSEL over its last half, of the drill if there; why.

    Of an even number the lower one of the middle two; without any PD, the first recorded trial.
    Raises NotDrawn if there is no recording.
    """
    recorded = sorted(
        {
            trial_of(row)
            for row in evaluation.rows
            if evaluation.recording(trial_of(row), row["method"]) is not None
        }
    )
    if not recorded:
        raise NotDrawn("there are no recordings; `recordings=true` of runners.evaluate keeps them")
    best = [trial for trial in recorded if evaluation.object_of[trial[0]] == _PREFERRED] or recorded
    rows = [row for row in last_half(evaluation.rows) if row["method"] == _METHOD]
    medians = {trial: spread(some, DIVERSITY) for trial, some in grouped(rows, trial_of).items()}
    ranked = sorted(
        (medians[trial].median, trial)
        for trial in best
        if trial in medians and medians[trial].count and evaluation.recording(trial, _METHOD)
    )
    if not ranked:
        return best[0], "the first one that is recorded"
    of_object = f" among those of {evaluation.object_of[best[0][0]]}" if best != recorded else ""
    return ranked[(len(ranked) - 1) // 2][1], f"that of the median PD of CHSEL{of_object}"
