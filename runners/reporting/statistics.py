"""Medians, means, ratios and shares by groups; what has no number is left out, never a zero."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from runners.reporting.evaluation_folder import TRIAL

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
