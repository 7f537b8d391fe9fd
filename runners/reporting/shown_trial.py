"""Which trial the pictures of a single one show."""

from __future__ import annotations

import re

from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError, Trial, trials_of
from runners.reporting.figures import NotDrawn
from runners.reporting.section import Subject
from runners.reporting.statistics import DIVERSITY

_PREFERRED = "drill"  # the object of the paper's pictures
_METHOD = "chsel"


def shown_trial(subject: Subject) -> tuple[Trial, str]:
    """The trial, and why this one unless it was asked for. Raises NotDrawn without a recording."""
    if subject.sequence.trial is None:
        return usual_trial(subject.evaluation)
    return named_trial(subject.sequence.trial), ""


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
    rows = evaluation.rows
    names = rows[[*TRIAL, "method"]].drop_duplicates().itertuples(index=False, name=None)
    recorded = sorted(
        {(name, seed) for name, seed, method in names if evaluation.recording((name, seed), method)}
    )
    if not recorded:
        raise NotDrawn("there are no recordings; `recordings=true` of runners.evaluate keeps them")
    of_preferred = trials_of(rows[rows["object"] == _PREFERRED])
    best = [trial for trial in recorded if trial in of_preferred] or recorded
    half = evaluation.last_half
    medians = half[half["method"] == _METHOD].groupby(TRIAL)[DIVERSITY].median().dropna()
    ranked = sorted(
        (medians[trial], trial)
        for trial in best
        if trial in medians.index and evaluation.recording(trial, _METHOD)
    )
    if not ranked:
        return best[0], "the first one that is recorded"
    among = f" among those of {_PREFERRED}" if best != recorded else ""
    return ranked[(len(ranked) - 1) // 2][1], f"that of the median PD of CHSEL{among}"
