"""How much of an evaluation of policies is there, and what went wrong."""

from __future__ import annotations

import pandas as pd

from runners.reporting.evaluation_folder import TRIAL, Evaluation, trials_of
from runners.reporting.section import Section, Styles
from runners.reporting.steered_sessions import SteeredSessions
from runners.reporting.tables import Cell, Table

_MOST_LISTED = 60
_FAILED = "failed"


def steered_completeness(
    evaluation: Evaluation, sessions: SteeredSessions, styles: Styles
) -> Section:
    """Counts of what is there, and what failed."""
    left_out = f", {sessions.left_out} are left out" if sessions.left_out else ""
    text = (
        "A trial is a configuration with a seed, in which every policy has a session of its own. "
        f"All other sections are about the {sessions.count} trials that all policies have "
        f"finished{left_out}."
    )
    tables = (counts_table(evaluation, styles), failures_table(evaluation.probes))
    return Section("what-was-run", "What was run", text, tables=tables)


def counts_table(evaluation: Evaluation, styles: Styles) -> Table:
    """Trials and probes of every policy."""
    probes, lines = evaluation.probes, []
    for policy in evaluation.planned_policies:
        own = probes[probes["policy"] == policy]
        failed = own["status"].str.startswith(_FAILED)
        done = trials_of(own[own["probes"].notna()])
        planned = len(set(evaluation.planned_trials) | done)
        steps = own["probes"].notna()
        stopped = int((own["stop"].fillna("") == "actions").sum())
        counts = (len(own[steps]), int((failed & steps).sum()), stopped)
        cells = (Cell(str(count)) for count in counts)
        broken = trials_of(own[failed]) - done
        trials = (Cell(f"{len(done)} of {planned}"), Cell(str(len(broken))))
        lines.append((Cell(styles[policy].title), *trials, *cells))
    header = ("policy", "trials done", "trials failed", "probes", "registrations failed")
    return Table("What is there", (*header, "out of actions"), tuple(lines))


def failures_table(probes: pd.DataFrame) -> Table:
    """What failed, a line for all that are alike in a configuration."""
    failed = probes[probes["status"].str.startswith(_FAILED)]
    groups = failed.groupby(["configuration", "policy", "status"], sort=False)
    lines = [
        tuple(map(Cell, (configuration, policy, str(len(some[TRIAL].drop_duplicates())), why)))
        for (configuration, policy, why), some in groups
    ]
    rest = len(lines) - _MOST_LISTED
    return Table(
        "What failed",
        ("configuration", "policy", "trials", "why"),
        tuple(lines[:_MOST_LISTED]),
        labels=4,
        note=f"and {rest} lines more" if rest > 0 else "",
    )
