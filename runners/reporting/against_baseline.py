"""All methods beside one of them: how much closer each is to the plausible sets, and how often."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError
from runners.reporting.section import Section, Styles, Subject
from runners.reporting.statistics import DIVERSITY
from runners.reporting.tables import Cell, Table, number, range_text, table_of

LEAST_PD = 1.0  # mm^2: a PD below counts as this in geometric means, which a 0 would make 0
_WORSE = 1.0 + 1e-9  # a ratio above; the rounding of a geometric mean makes no PD worse
_PLACE = [*TRIAL, "step"]


def against_baseline(subject: Subject) -> Section | None:
    """Tables of all methods beside the baseline. Raises ReportError if that has no PD.

    None without a baseline, and for policies.
    """
    evaluation, baseline = subject.evaluation, subject.baseline
    if baseline is None or evaluation.is_steered:
        return None
    rows = with_ratios(evaluation.rows, baseline)
    text = (
        "Over all registrations: every step of every trial, and every draw, that is the same "
        f"session registered with other random numbers. A ratio is PD by that of {baseline} at the "
        "same trial and step, by the geometric mean of its draws where there are several; worse "
        f"is a ratio above 1. PD below {LEAST_PD:g} mm² counts as {LEAST_PD:g} mm² in geometric "
        "means and ratios. What has failed has no PD and is left out, n says of how many numbers."
    )
    if rows["ratio"].isna().all():
        raise ReportError(
            f"baseline {baseline} has no PD; accepted: {', '.join(evaluation.methods)}"
        )
    tables = (
        _summary(evaluation, subject.styles, baseline, rows),
        *(_ratios(rows, subject.styles, by) for by in ("object", "step")),
    )
    return Section("against-baseline", f"All methods beside {baseline}", text, tables=tables)


def with_ratios(rows: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """The rows with `floored`, PD of at least LEAST_PD, and `ratio`, that by the baseline's.

    The baseline's PD at a trial and step is the geometric mean over its draws.
    """
    rows = rows.assign(floored=rows[DIVERSITY].clip(lower=LEAST_PD))
    of_baseline = rows[rows["method"] == baseline].groupby(_PLACE)["floored"].agg(geometric_mean)
    rows = rows.join(of_baseline.rename("of_baseline"), on=_PLACE)
    return rows.assign(ratio=rows["floored"] / rows["of_baseline"])


def geometric_mean(values: pd.Series) -> float:
    """Of positive numbers, without those that are NaN; NaN of nothing."""
    return math.exp(np.log(values).mean())


@dataclass(frozen=True)
class _Compared:
    """A method beside the baseline."""

    title: str
    rows: pd.DataFrame  # of the method, with ratios
    is_baseline: bool


def _worse(of: _Compared) -> str:
    ratios = of.rows["ratio"].dropna()
    return "-" if of.is_baseline else _percent((ratios > _WORSE).mean())


def _count(of: _Compared) -> Cell:
    left_out = of.rows[DIVERSITY].isna().sum()
    return Cell(str(of.rows[DIVERSITY].count()), note=f"{left_out} left out" if left_out else "")


def _median(of: _Compared) -> Cell:
    lower, median, upper = of.rows[DIVERSITY].quantile([0.25, 0.5, 0.75])
    return Cell(number(median), between=range_text(lower, upper))


def _distinct(of: _Compared) -> Cell:
    distinct = of.rows["distinct"].dropna()
    return Cell(
        number(distinct.mean()), between="" if distinct.empty else f"[{distinct.min():.0f}]"
    )


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"


def _summary(evaluation: Evaluation, styles: Styles, baseline: str, rows: pd.DataFrame) -> Table:
    columns: Mapping[str, Callable[[_Compared], Cell | str | float]] = {
        "method": lambda of: of.title,
        "n": _count,
        "PD in mm², median [quartiles]": _median,
        "geometric mean": lambda of: geometric_mean(of.rows["floored"]),
        f"ratio to {baseline}": lambda of: geometric_mean(of.rows["ratio"]),
        "worse": _worse,
        "members": lambda of: _percent(of.rows["exact_members"].mean()),
        "distinct [least]": _distinct,
        "s, median": lambda of: of.rows["seconds"].dropna().median(),
        "s, mean": lambda of: of.rows["seconds"].mean(),
    }
    note = (
        "Ratio: the geometric mean of all. Members: the mean share of hypotheses that are members "
        f"of the plausible set by its definition, {evaluation.definition_text}. Distinct: poses, "
        "on average."
    )
    compared = [
        _Compared(style.title, rows[rows["method"] == method], method == baseline)
        for method, style in styles.items()
    ]
    title = f"PD and its ratios over all registrations, by {evaluation.definition}"
    return table_of(title, columns, compared, note=note)


def _ratios(rows: pd.DataFrame, styles: Styles, by: str) -> Table:
    """Geometric means of the ratios, by what a column holds."""
    found = rows.groupby([by, "method"])["ratio"].agg(geometric_mean).unstack()
    found = found.reindex(columns=list(styles))
    lines = [
        (Cell(str(value)), *(Cell(number(ratio)) for ratio in ratios))
        for value, ratios in zip(found.index, found.to_numpy(), strict=True)
    ]
    header = (by, *(style.title for style in styles.values()))
    return Table(f"Ratios of PD by {by}, geometric means", header, tuple(lines))
