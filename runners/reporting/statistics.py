"""Statistics of registrations and of steered sessions; what has no number is left out, never 0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError

DIVERSITY = "diversity"
"""The column with PD in mm^2."""
LEAST_PD = 1.0  # mm^2: a PD below counts as this in geometric means, which a 0 would make 0
_WORSE = 1.0 + 1e-9  # a ratio above; the rounding of a geometric mean makes no PD worse
_RESAMPLES = 2000
_HIT_BINS = np.linspace(0.0, 1.0, 11)


def spreads(rows: pd.DataFrame, by: str | Sequence[str], column: str) -> pd.DataFrame:
    """A row per group with the spread of a column's numbers.

    Columns: count of the numbers; left_out, how many more there could be were they not missing;
    lower, median and upper quartile, interpolated between neighbours; mean and deviation (the
    standard deviation over n); NaN where there are no numbers.
    """
    groups = rows.astype({column: float}).groupby(by, observed=True)[column]
    count = groups.count()
    return pd.DataFrame(
        {
            "count": count,
            "left_out": groups.size() - count,
            "lower": groups.quantile(0.25),
            "median": groups.median(),
            "upper": groups.quantile(0.75),
            "mean": groups.mean(),
            "deviation": groups.std(ddof=0),
        }
    )


def shares(rows: pd.DataFrame, by: str | Sequence[str], column: str) -> pd.DataFrame:
    """A row per group: how many of a column's flags are set, of how many, and their share.

    lower, upper: 95 % interval of the share of independent cases (Wilson's score interval).
    Groups without a flag have no row.
    """
    flags = rows[rows[column].notna()].astype({column: int}).groupby(by, observed=True)[column]
    found = pd.DataFrame({"count": flags.sum(), "total": flags.size(), "share": flags.mean()})
    counts = zip(found["count"], found["total"], strict=True)
    tests = [binomtest(count, total) for count, total in counts]
    intervals = [test.proportion_ci(method="wilson") for test in tests]
    return found.assign(
        lower=[interval.low for interval in intervals],
        upper=[interval.high for interval in intervals],
    )


def geometric_mean(values: pd.Series) -> float:
    """Of positive numbers, without those that are NaN; NaN of nothing."""
    return math.exp(np.log(values).mean())


def with_ratios(rows: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """The rows with `floored`, PD of at least LEAST_PD, and `ratio`, that by the baseline's.

    The baseline's PD at a trial and step is the geometric mean over its draws.
    """
    place = [*TRIAL, "step"]
    rows = rows.assign(floored=rows[DIVERSITY].clip(lower=LEAST_PD))
    of_baseline = rows[rows["method"] == baseline].groupby(place)["floored"].agg(geometric_mean)
    rows = rows.join(of_baseline.rename("of_baseline"), on=place)
    return rows.assign(ratio=rows["floored"] / rows["of_baseline"])


def share_worse(ratios: pd.Series) -> float:
    """How many of the ratios are above 1; NaN of nothing."""
    ratios = ratios.dropna()
    return float((ratios > _WORSE).mean()) if len(ratios) else math.nan


def bootstrap_interval(values: pd.Series) -> tuple[float, float]:
    """95 % interval of the mean of values by (configuration, seed), configurations resampled.

    The same every time.
    """
    groups = values.groupby("configuration")
    sums, counts = groups.sum().to_numpy(), groups.count().to_numpy()
    drawn = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1).clip(min=1)
    lower, upper = np.quantile(means, [0.025, 0.975])
    return float(lower), float(upper)


def first_below(values: pd.DataFrame, limit: float) -> pd.Series:
    """The number of probes (the columns) after which sessions (the rows) first are below a limit.

    Infinite for those that never are.
    """
    below = values.to_numpy() < limit
    number = np.array(values.columns, dtype=float)[np.argmax(below, axis=1)]
    return pd.Series(np.where(below.any(axis=1), number, np.inf), values.index)


def censored_quantile(numbers: pd.Series, share: float) -> float:
    """The least number by which this share of the sessions has come there; infinite if none.

    Sessions that end before count as infinite, so this is the Kaplan-Meier estimate: nothing is
    censored before the budget is spent. NaN of no session.
    """
    if numbers.empty:
        return math.nan
    return float(np.quantile(numbers, share, method="inverted_cdf"))


def hit_bins(rows: pd.DataFrame) -> pd.DataFrame:
    """`shares` of hits by tenths of their forecast, with the mean `forecast` of each."""
    tenth = np.digitize(rows["hit_forecast"], _HIT_BINS).clip(max=10) - 1
    rows = rows.assign(tenth=tenth)
    forecasts = rows.groupby("tenth")["hit_forecast"].mean()
    return shares(rows, "tenth", "hit").join(forecasts.rename("forecast"))


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
    asked = evaluation.experiment["policies"].values()
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
