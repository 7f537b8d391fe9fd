"""Sessions that policies have steered: what is known after each probe, by policy and session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError

REFERENCE = "information"
"""The policy that all others are compared with, unless another one is asked for."""
LEAST_ERROR = 1e-4  # metres: an error below counts as this in geometric means
GOOD = 0.010  # metres: what counts as found
LIMITS = (0.020, GOOD, 0.005)  # metres
_RESAMPLES = 2000
_SEED = 0
SESSION = ["policy", *TRIAL]
"""The columns that tell sessions apart."""


@dataclass(frozen=True, eq=False)
class SteeredSessions:
    """The rows of all sessions that every policy has finished, so that all have the same ones."""

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

    def after(self, probes: int) -> int:
        """This number of probes, or the greatest below it that any session has."""
        return max(number for number in self.errors.columns if number <= probes)

    @cached_property
    def solvable(self) -> pd.MultiIndex:
        """Trials that any policy solves: an error below GOOD at some time."""
        best = self.errors.min(axis=1).groupby(TRIAL).min()
        return best[best < GOOD].index


def steered_sessions(evaluation: Evaluation, reference: str | None = None) -> SteeredSessions:
    """The sessions of an evaluation. Raises ReportError for a reference without any."""
    rows, asked = evaluation.probes, evaluation.experiment.get("policies")
    asked = asked if isinstance(asked, Mapping) else {}
    rows = rows[rows["probes"].notna() & (rows["probes"] >= 1)].astype({"probes": int})
    rows = rows.drop_duplicates([*SESSION, "probes"], keep="last")
    known = rows[rows["error"].notna()]
    first = known.groupby(SESSION)["probes"].min()
    begun = first[first == 1].reset_index()
    policies = [name for name in evaluation.planned_policies if (begun["policy"] == name).any()]
    if reference is not None and reference not in policies:
        raise ReportError(f"baseline {reference} has no session; accepted: {', '.join(policies)}")
    if reference is None and policies:
        reference = REFERENCE if REFERENCE in policies else policies[0]
    having = begun.groupby(TRIAL)["policy"].nunique()
    common = having[having == len(policies)].index
    kept = pd.MultiIndex.from_frame(rows[TRIAL]).isin(common) & rows["policy"].isin(policies)
    budget = min((_probes(one) for one in asked.values()), default=0)
    budget = budget or int(rows["probes"].max() if len(rows) else 1)
    rows = rows[kept & (rows["probes"] <= budget)].reset_index(drop=True)
    return SteeredSessions(policies, budget, rows, len(having) - len(common), reference or "")


def _probes(policy: Any) -> int:
    """The budget of a policy by experiment.json; 0 if that does not say."""
    settings = policy.get("settings") if isinstance(policy, Mapping) else None
    probes = settings.get("probes") if isinstance(settings, Mapping) else None
    return probes if isinstance(probes, int) and probes > 0 else 0


def geometric_means(values: pd.DataFrame) -> pd.DataFrame:
    """By policy and number of probes, of `over_probes`, metres."""
    logs = np.log(values.clip(lower=LEAST_ERROR))
    return np.exp(logs.groupby("policy", sort=False).mean())


def bootstrap_interval(values: pd.Series) -> tuple[float, float]:
    """95 % interval of the mean of values by (configuration, seed), configurations resampled.

    The same every time.
    """
    groups = values.groupby("configuration")
    sums, counts = groups.sum().to_numpy(), groups.count().to_numpy()
    drawn = np.random.default_rng(_SEED).integers(len(sums), size=(_RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1).clip(min=1)
    lower, upper = np.quantile(means, [0.025, 0.975])
    return float(lower), float(upper)


def first_below(values: pd.DataFrame, limit: float) -> pd.Series:
    """The number of probes after which sessions of `over_probes` first are below a limit.

    Infinite for those that never are.
    """
    below = values.to_numpy() < limit
    number = np.array(values.columns, dtype=float)[np.argmax(below, axis=1)]
    return pd.Series(np.where(below.any(axis=1), number, np.inf), values.index)


def censored_quantile(numbers: pd.Series, share: float) -> float:
    """The least number by which this share of the sessions has come there; infinite if none.

    Sessions that end before count as infinite, so this is the Kaplan-Meier estimate: nothing is
    censored before the budget is spent.
    """
    if numbers.empty:
        return float("nan")
    return float(np.quantile(numbers, share, method="inverted_cdf"))
