"""Every policy beside the reference, session by session; and all of them by configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from runners.reporting.section import Section, Styles
from runners.reporting.steered_sessions import (
    LEAST_ERROR,
    SteeredSessions,
    bootstrap_interval,
    geometric_means,
)
from runners.reporting.tables import Cell, Table, number, range_text

PROBES = 10
"""After so many probes errors are compared, or at the end of shorter sessions."""
_MM = 1000.0


@dataclass(frozen=True)
class Paired:
    """A policy beside the reference, over the same sessions."""

    policy: str
    sessions: int
    wins: int  # sessions in which the reference has the smaller error
    losses: int
    sign_test: float  # chance of wins and losses as uneven as these if both were as good
    median: float  # of the policy's error by the reference's
    mean: float  # geometric, of the same
    lower: float  # 95 % interval of that mean
    upper: float


def policies_compared(sessions: SteeredSessions, styles: Styles) -> Section | None:
    """None unless there are sessions of two policies."""
    if len(sessions.policies) < 2 or not sessions.count:
        return None
    probes = sessions.after(PROBES)
    text = (
        f"Errors of the set after {probes} probes, session by session. A ratio is the error of a "
        f"policy by that of {styles[sessions.reference].title} in the same configuration with the "
        "same seed; above 1 the latter is better."
    )
    tables = [paired_table(sessions, styles), by_table(sessions, styles, "configuration")]
    if sessions.rows["faults"].nunique() > 1:
        tables.append(by_table(sessions, styles, "faults"))
    title = "Policies compared, session by session"
    return Section("policies-compared", title, text, tables=tuple(tables))


def paired_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """A row for every policy but the reference."""
    title = styles[sessions.reference].title
    header = ("policy", "sessions", f"{title} better", "worse", "sign test, p")
    ratios = ("ratio, median", "ratio, geometric mean [95 %]")
    rows = []
    for policy in sessions.policies:
        if policy == sessions.reference:
            continue
        of = paired(sessions, policy)
        mean = Cell(number(of.mean), between=range_text(of.lower, of.upper))
        counts = (Cell(str(count)) for count in (of.sessions, of.wins, of.losses))
        test = Cell(f"{of.sign_test:.2g}")
        rows.append((Cell(styles[policy].title), *counts, test, Cell(number(of.median)), mean))
    note = (
        "The interval is a bootstrap over configurations, of which all seeds are drawn together; "
        "the sign test takes sessions as independent."
    )
    name = f"Error beside {title} after {sessions.after(PROBES)} probes"
    return Table(name, (*header, *ratios), tuple(rows), note=note)


def paired(sessions: SteeredSessions, policy: str) -> Paired:
    """A policy beside the reference."""
    errors = sessions.errors[sessions.after(PROBES)].clip(lower=LEAST_ERROR)
    logs = np.log(errors.loc[policy] / errors.loc[sessions.reference])
    wins, losses = int((logs > 0.0).sum()), int((logs < 0.0).sum())
    test = binomtest(wins, wins + losses).pvalue if wins + losses else 1.0
    lower, upper = bootstrap_interval(logs)
    return Paired(
        policy,
        len(logs),
        wins,
        losses,
        float(test),
        math.exp(logs.median()),
        math.exp(logs.mean()),
        math.exp(lower),
        math.exp(upper),
    )


def by_table(sessions: SteeredSessions, styles: Styles, by: str) -> Table:
    """Geometric means of the errors by what a column of the rows holds, mm."""
    probes = sessions.after(PROBES)
    rows = []
    for value, some in sessions.rows.groupby(by, sort=True):
        trials = pd.MultiIndex.from_frame(some[["configuration", "seed"]].drop_duplicates())
        own = sessions.errors[sessions.errors.index.droplevel("policy").isin(trials)]
        means = _MM * geometric_means(own)[probes]
        best = means.min()
        cells = [
            Cell(number(means[policy]), best=bool(means[policy] == best))
            for policy in sessions.policies
        ]
        rows.append((Cell(str(value)), Cell(str(len(trials))), *cells))
    header = (by, "n", *(styles[policy].title for policy in sessions.policies))
    title = f"Error after {probes} probes by {by}, mm"
    return Table(title, header, tuple(rows), note="Geometric means over n sessions of a policy.")
