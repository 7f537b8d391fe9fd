"""Statistics of registrations and of steered sessions; what has no number is left out, never 0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from chsel.errors import SettingError
from runners.reporting.evaluation_folder import TRIAL, Evaluation

DIVERSITY = "diversity"  # the column with PD in mm^2
LEAST_PD = 1.0  # mm^2: a PD below counts as this in geometric means, which a 0 would make 0
LEAST_ERROR = 1e-4  # metres: an error below counts as this in geometric means
GOOD = 0.010  # metres: what counts as found
REFERENCE = "information"  # with which all policies are compared, unless another is asked for
PROBES = 10  # after so many errors are compared, or at the end of shorter sessions
SESSION = ["policy", *TRIAL]  # the columns that tell sessions apart
_RESAMPLES, _FEW = 2000, 5


def spreads(rows: pd.DataFrame, by: str | Sequence[str], *, column: str) -> pd.DataFrame:
    """Return a row per group with the spread of a column's numbers; NaN where there are none.

    left_out: how many are missing. lower, upper: quartiles, interpolated; a single number has none.
    deviation: over n.
    """
    groups = rows.astype({column: float}).groupby(by, observed=True)[column]
    count = groups.count()
    return pd.DataFrame(
        {
            "count": count,
            "left_out": groups.size() - count,
            "lower": groups.quantile(0.25).where(count > 1),
            "median": groups.median(),
            "upper": groups.quantile(0.75).where(count > 1),
            "mean": groups.mean(),
            "deviation": groups.std(ddof=0),
        }
    )


def shares(rows: pd.DataFrame, by: str | Sequence[str], *, column: str) -> pd.DataFrame:
    """Return a row per group with flags: how many are set, of how many, and their share.

    lower, upper: 95 % interval of the share of independent cases (Wilson's score interval).
    """
    flags = rows[rows[column].notna()].astype({column: int}).groupby(by, observed=True)[column]
    found = pd.DataFrame({"count": flags.sum(), "total": flags.size(), "share": flags.mean()})
    tests = map(binomtest, found["count"], found["total"])
    intervals = [tuple(test.proportion_ci(method="wilson")) for test in tests]
    return found.join(pd.DataFrame(intervals, found.index, ["lower", "upper"]))


def geometric_mean(values: pd.Series) -> float:
    """Return the geometric mean of positive numbers, without NaN; NaN of nothing."""
    return math.exp(np.log(values).mean())


def ratio_interval(rows: pd.DataFrame) -> tuple[float, float, float]:
    """Return the geometric mean of `with_ratios`, and its 95 % interval, NaN of one session."""
    logs = np.log(rows.set_index(TRIAL)["ratio"].dropna())
    mean, lower, upper = (math.exp(log) for log in (logs.mean(), *bootstrap_interval(logs)))
    return mean, lower, upper


def with_ratios(rows: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """Return the rows with `floored`, PD of at least LEAST_PD, and `ratio`, that by the baseline's.

    Of the baseline the geometric mean over its draws at the same trial and step.
    """
    place = [*TRIAL, "step"]
    rows = rows.assign(floored=rows[DIVERSITY].clip(lower=LEAST_PD))
    of_baseline = rows[rows["method"] == baseline].groupby(place)["floored"].agg(geometric_mean)
    rows = rows.join(of_baseline.rename("of_baseline"), on=place)
    return rows.assign(ratio=rows["floored"] / rows["of_baseline"])


def bootstrap_interval(values: pd.Series) -> tuple[float, float]:
    """Return the 95 % interval of a mean by (configuration, seed), resampling configurations.

    Sessions are resampled if there are less than _FEW configurations; NaN of a single session.
    """
    many = values.index.get_level_values("configuration").nunique() >= _FEW
    groups = values.groupby("configuration" if many else TRIAL)
    if len(groups) < 2:
        return math.nan, math.nan
    sums, counts = groups.sum().to_numpy(), groups.count().to_numpy()
    drawn = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1).clip(min=1)
    lower, upper = np.quantile(means, [0.025, 0.975])
    return float(lower), float(upper)


def first_below(values: pd.DataFrame, limit: float) -> pd.Series:
    """Return the number of probes (columns) after which sessions (rows) are first below."""
    below = values < limit
    return below.idxmax(axis=1).where(below.any(axis=1), np.inf).astype(float)


def censored_quantile(numbers: pd.Series, share: float) -> float:
    """Return the least number by which this share of sessions has come there (Kaplan-Meier).

    Sessions that never do are infinite: nothing is censored before the budget is spent.
    """
    return float(np.quantile(numbers, share, method="inverted_cdf")) if len(numbers) else math.nan


def by_tenths(rows: pd.DataFrame, forecast: str, *, happened: str) -> pd.DataFrame:
    """Return `shares` by tenths of the forecast, with the mean `forecast` of each."""
    tenths = np.digitize(rows[forecast], np.linspace(0.0, 1.0, 11)).clip(max=10) - 1
    rows = rows.assign(tenth=tenths)
    forecasts = rows.groupby("tenth")[forecast].mean()
    return shares(rows, "tenth", column=happened).join(forecasts.rename("forecast"))


@dataclass(frozen=True, eq=False)
class SteeredSessions:
    """The rows of all trials that every policy has finished, so that all have the same ones."""

    policies: list[str]  # with a finished session
    budget: int  # probes of a session, at most
    rows: pd.DataFrame  # with the columns of runners.evaluation.experiment.PROBES
    count: int  # trials
    left_out: int  # trials that some policy has and another one has not
    reference: str  # one of the policies, that others are compared with

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Errors of the set, metres; see `over_probes`."""
        return self.over_probes("error")

    def over_probes(self, column: str) -> pd.DataFrame:
        """Return a row per session (policy, configuration, seed), a column per number of probes.

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
    """Return the sessions of an evaluation; raise SettingError for a reference without any."""
    rows = evaluation.probes
    rows = rows[rows["probes"].notna()].astype({"probes": int})
    first = rows[rows["error"].notna()].groupby(SESSION)["probes"].min()
    begun = first[first == 1].reset_index()
    asked = evaluation.experiment["policies"]
    policies = [name for name in asked if (begun["policy"] == name).any()]
    if reference is not None and reference not in policies:
        raise SettingError(f"baseline {reference} has no session; accepted: {', '.join(policies)}")
    if reference is None and policies:
        reference = REFERENCE if REFERENCE in policies else policies[0]
    having = begun.groupby(TRIAL)["policy"].nunique()
    common = having[having == len(policies)].index
    kept = pd.MultiIndex.from_frame(rows[TRIAL]).isin(common) & rows["policy"].isin(policies)
    budget = min((one["settings"]["probes"] for one in asked.values()), default=1)
    rows = rows[kept & (rows["probes"] <= budget)].reset_index(drop=True)
    left_out = len(having) - len(common)
    return SteeredSessions(
        policies, budget, rows=rows, count=len(common), left_out=left_out, reference=reference or ""
    )


def geometric_means(values: pd.DataFrame) -> pd.DataFrame:
    """Return means of `over_probes` by policy and number of probes, metres."""
    return np.exp(_logs(values).groupby("policy", sort=False).mean())


def _logs(errors: Any) -> Any:
    return np.log(errors.clip(lower=LEAST_ERROR))


def means_with_intervals(sessions: SteeredSessions, column: str) -> pd.DataFrame:
    """Return `mean`, geometric, and its 95 % interval by number (the column), policy and probes."""
    logs = _logs(sessions.over_probes(column))
    lines = []
    for policy in sessions.policies:
        for probes, own in logs.loc[policy].items():
            lower, upper = bootstrap_interval(own)
            lines.append((column, policy, probes, *np.exp([lower, own.mean(), upper])))
    return pd.DataFrame(lines, columns=["number", "policy", "probes", "lower", "mean", "upper"])


def ratios_to_best(sessions: SteeredSessions) -> pd.Series:
    """Return error of the reference by that of the best other policy, by number of probes."""
    means = geometric_means(sessions.errors)
    return means.loc[sessions.reference] / means.drop(index=sessions.reference).min()


def paired(sessions: SteeredSessions, policy: str) -> dict[str, float]:
    """Return wins and losses of the reference against a policy over the same sessions.

    sign_test: chance of wins and losses as uneven if both were as good. Of the policy's error by
    the reference's: median, geometric mean, and its 95 % interval.
    """
    errors = _logs(sessions.errors[sessions.compared])
    logs = errors.loc[policy] - errors.loc[sessions.reference]
    wins = int((logs > 0.0).sum())
    losses = int((logs < 0.0).sum())
    test = float(binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0
    lower, upper = bootstrap_interval(logs)
    ratios = {"median": logs.median(), "mean": logs.mean(), "lower": lower, "upper": upper}
    counts = {"sessions": len(logs), "wins": wins, "losses": losses, "sign_test": test}
    return counts | {name: math.exp(log) for name, log in ratios.items()}


def first_stops(rows: pd.DataFrame, spread: float) -> pd.DataFrame:
    """Return the first row of each session with at most this spread of the belief, metres."""
    narrow = rows[rows["spread"] <= spread].sort_values([*SESSION, "probes"])
    return narrow.drop_duplicates(SESSION)
