"""Medians, quartiles and shares by groups; what has no number is counted apart, never as a zero."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from scipy.stats import binomtest

DIVERSITY = "diversity"
"""The column with PD in mm^2."""


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
    tests = [
        binomtest(count, total) for count, total in zip(found["count"], found["total"], strict=True)
    ]
    intervals = [test.proportion_ci(method="wilson") for test in tests]
    return found.assign(
        lower=[interval.low for interval in intervals],
        upper=[interval.high for interval in intervals],
    )
