"""Sessions that policies have steered: what is known after each probe, by policy and session."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError
from runners.reporting.statistics import bootstrap_interval

REFERENCE = "information"
"""The policy that all others are compared with, unless another one is asked for."""
LEAST_ERROR = 1e-4  # metres: an error below counts as this in geometric means
GOOD = 0.010  # metres: what counts as found
LIMITS = (0.020, GOOD, 0.005)  # metres
PROBES = 10
"""After so many probes errors are compared, or at the end of shorter sessions."""
SESSION = ["policy", *TRIAL]
"""The columns that tell sessions apart."""


@dataclass(frozen=True, eq=False)
class SteeredSessions:
    """The rows of all trials that every policy has finished, so that all have the same ones."""

    policies: list[str]  # with a finished session
    budget: int  # probes of a session, at most
    rows: pd.DataFrame  # with the columns of runners.evaluation.table.PROBES
    left_out: int  # trials that some policy has and another one has not
    reference: str  # one of the policies, that others are compared with

    @property
    def count(self) -> int:
        """Trials."""
        return self.rows.groupby(TRIAL).ngroups

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Errors of the set, metres; see `over_probes`."""
        return self.over_probes("error")

    def over_probes(self, column: str) -> pd.DataFrame:
        """A row per session (policy, configuration, seed), a column per number of probes.

        A session that ends before others keeps its last number.
        """
        return self.rows.pivot(index=SESSION, columns="probes", values=column).ffill(axis=1)

    @property
    def compared(self) -> int:
        """The number of probes after which errors are compared."""
        return max(number for number in self.errors.columns if number <= PROBES)

    @cached_property
    def solvable(self) -> pd.MultiIndex:
        """Trials that any policy solves: an error below GOOD at some time."""
        best = self.errors.min(axis=1).groupby(TRIAL).min()
        return best[best < GOOD].index

    @cached_property
    def forecasts(self) -> pd.DataFrame:
        """The rows with a forecast and an outcome; `touched`: a contact came before the probe."""
        rows = self.rows.sort_values([*SESSION, "probes"])
        before = rows.groupby(SESSION)["contacts"].shift(1).fillna(0.0)
        rows = rows.assign(touched=before.astype(float) > 0.0)
        return rows[rows["hit_forecast"].notna() & rows["hit"].notna()].astype({"hit": float})


def steered_sessions(evaluation: Evaluation, reference: str | None = None) -> SteeredSessions:
    """The sessions of an evaluation. Raises ReportError for a reference without any."""
    rows = evaluation.probes
    rows = rows[rows["probes"].notna()].astype({"probes": int})
    first = rows[rows["error"].notna()].groupby(SESSION)["probes"].min()
    begun = first[first == 1].reset_index()
    policies = [name for name in evaluation.policies if (begun["policy"] == name).any()]
    if reference is not None and reference not in policies:
        raise ReportError(f"baseline {reference} has no session; accepted: {', '.join(policies)}")
    if reference is None and policies:
        reference = REFERENCE if REFERENCE in policies else policies[0]
    having = begun.groupby(TRIAL)["policy"].nunique()
    common = having[having == len(policies)].index
    kept = pd.MultiIndex.from_frame(rows[TRIAL]).isin(common) & rows["policy"].isin(policies)
    asked = evaluation.experiment.get("policies", {}).values()
    budget = min((one["settings"]["probes"] for one in asked), default=1)
    rows = rows[kept & (rows["probes"] <= budget)].reset_index(drop=True)
    return SteeredSessions(policies, budget, rows, len(having) - len(common), reference or "")


def geometric_means(values: pd.DataFrame) -> pd.DataFrame:
    """By policy and number of probes, of `over_probes`, metres."""
    logs = np.log(values.clip(lower=LEAST_ERROR))
    return np.exp(logs.groupby("policy", sort=False).mean())


def means_with_intervals(sessions: SteeredSessions, column: str) -> pd.DataFrame:
    """By policy and number of probes: `mean`, geometric, and its 95 % interval, metres."""
    values = sessions.over_probes(column)
    logs, lines = np.log(values.clip(lower=LEAST_ERROR)), []
    for policy in sessions.policies:
        for probes, own in logs.loc[policy].items():
            lower, upper = np.exp(bootstrap_interval(own))
            mean = float(np.exp(own.mean()))
            lines.append((policy, probes, lower, mean, upper))
    return pd.DataFrame(lines, columns=["policy", "probes", "lower", "mean", "upper"])


def ratios_to_best(sessions: SteeredSessions) -> pd.Series:
    """Error of the reference by that of the best other policy, by number of probes."""
    means = geometric_means(sessions.errors)
    return means.loc[sessions.reference] / means.drop(index=sessions.reference).min()


@dataclass(frozen=True)
class Paired:
    """A policy beside the reference, over the same sessions."""

    sessions: int
    wins: int  # sessions in which the reference has the smaller error
    losses: int
    sign_test: float  # chance of wins and losses as uneven as these if both were as good
    median: float  # of the policy's error by the reference's
    mean: float  # geometric, of the same
    lower: float  # 95 % interval of that mean
    upper: float


def paired(sessions: SteeredSessions, policy: str) -> Paired:
    """A policy beside the reference."""
    errors = sessions.errors[sessions.compared].clip(lower=LEAST_ERROR)
    logs = np.log(errors.loc[policy] / errors.loc[sessions.reference])
    wins, losses = int((logs > 0.0).sum()), int((logs < 0.0).sum())
    test = float(binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0
    ratios = [math.exp(log) for log in (logs.median(), logs.mean(), *bootstrap_interval(logs))]
    return Paired(len(logs), wins, losses, test, *ratios)


def first_stops(rows: pd.DataFrame, spread: float) -> pd.DataFrame:
    """Of each session the first row with at most this spread of the belief, metres."""
    narrow = rows[rows["spread"] <= spread].sort_values([*SESSION, "probes"])
    return narrow.drop_duplicates(SESSION)
