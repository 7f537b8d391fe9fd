"""All methods beside one of them: how much closer each is to the plausible sets, and how often."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from runners.reporting.evaluation_folder import Evaluation, ReportError, Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.section import Cell, Section, Table, number
from runners.reporting.statistics import Spread, grouped, spread, trial_of
from runners.reporting.tables import DIVERSITY

LEAST_PD = 1.0  # mm^2: a PD below counts as this in geometric means, which a 0 would make 0
_WORSE = 1.0 + 1e-9  # a ratio above; the rounding of a geometric mean makes no PD worse
MISSED = 0.003  # m: a best energy above this is none of the right pose's
_ENERGY = ("anchored",)  # methods whose cost is an energy in metres
Styles = Mapping[str, MethodStyle]


def section_against(evaluation: Evaluation, styles: Styles, baseline: str) -> Section:
    """Tables of all methods beside the baseline. Raises ReportError if that has no PD."""
    base = baseline_pd(evaluation.rows, baseline)
    if not base:
        raise ReportError(
            f"baseline {baseline} has no PD; accepted: {', '.join(evaluation.methods)}"
        )
    text = (
        "Over all registrations: every step of every trial, and every draw, that is the same "
        f"session registered with other random numbers. A ratio is PD by that of {baseline} at the "
        "same trial and step, by the geometric mean of its draws where there are several; worse "
        f"is a ratio above 1. PD below {LEAST_PD:g} mm² counts as {LEAST_PD:g} mm² in geometric "
        "means and ratios. What has failed has no PD and is left out, n says of how many numbers."
    )
    tables = (
        _summary(evaluation, styles, baseline, base),
        _ratios(evaluation, styles, base, "object"),
        _ratios(evaluation, styles, base, "step"),
    )
    return Section("against-baseline", f"All methods beside {baseline}", text, tables=tables)


def baseline_pd(rows: Iterable[Row], baseline: str) -> dict[Hashable, float]:
    """PD of the baseline by trial and step: the geometric mean over its draws."""
    own = [row for row in rows if row["method"] == baseline and row[DIVERSITY] is not None]
    return {place: geometric_mean(pd_of(some)) for place, some in grouped(own, _place).items()}


def pd_ratios(rows: Iterable[Row], base: Mapping[Hashable, float]) -> list[float]:
    """PD by that of the baseline, of rows where both have one."""
    both = [row for row in rows if row[DIVERSITY] is not None and _place(row) in base]
    return [pd / base[_place(row)] for row, pd in zip(both, pd_of(both), strict=True)]


def pd_of(rows: Iterable[Row]) -> list[float]:
    """PD in mm^2 of the rows that have one, at least LEAST_PD."""
    return [max(value, LEAST_PD) for value in spread(rows, DIVERSITY).values]


def geometric_mean(values: Sequence[float]) -> float:
    """Of positive numbers; NaN of nothing."""
    return math.exp(float(np.mean(np.log(values)))) if len(values) else math.nan


def _summary(
    evaluation: Evaluation, styles: Styles, baseline: str, base: Mapping[Hashable, float]
) -> Table:
    by_method = grouped(evaluation.rows, lambda row: row["method"])
    lines = []
    for method, style in styles.items():
        rows = by_method.get(method, [])
        pd, seconds = spread(rows, DIVERSITY), spread(rows, "seconds")
        ratios = pd_ratios(rows, base)
        worse = "-" if method == baseline else _share(ratio > _WORSE for ratio in ratios)
        exact, distinct = spread(rows, "exact_members"), spread(rows, "distinct")
        least = f"[{min(distinct.values):.0f}]" if distinct.count else ""
        lines.append(
            (
                Cell(style.title),
                Cell(str(pd.count), note=f"{pd.left_out} left out" if pd.left_out else ""),
                _quartiles(pd),
                Cell(number(geometric_mean(pd_of(rows)))),
                Cell(number(geometric_mean(ratios))),
                Cell(worse),
                Cell(_percent(exact.mean)),
                Cell(number(distinct.mean), between=least),
                Cell(_misses(evaluation, method, rows)),
                Cell(number(seconds.median)),
                Cell(number(seconds.mean)),
            )
        )
    header = (
        "method",
        "n",
        "PD in mm², median [quartiles]",
        "geometric mean",
        f"ratio to {baseline}",
        "worse",
        "members",
        "distinct [least]",
        "misses",
        "s, median",
        "s, mean",
    )
    note = (
        "Ratio: the geometric mean of all. Members: the mean share of hypotheses that are members "
        f"of the plausible set by its definition, {evaluation.definition_text}. Distinct: poses, "
        f"the mean. Misses: registrations whose best energy is above {1000.0 * MISSED:g} mm, where "
        "the cost is an energy."
    )
    title = f"PD and its ratios over all registrations, by {evaluation.definition}"
    return Table(title, header, tuple(lines), note=note)


def _ratios(
    evaluation: Evaluation, styles: Styles, base: Mapping[Hashable, float], column: str
) -> Table:
    """Geometric means of the ratios, by what a column holds."""
    rows = [row for row in evaluation.rows if row[column] is not None]
    lines = []
    for value in sorted({row[column] for row in rows}):
        cells = [Cell(str(value))]
        for method in styles:
            own = [row for row in rows if (row[column], row["method"]) == (value, method)]
            cells.append(Cell(number(geometric_mean(pd_ratios(own, base)))))
        lines.append(tuple(cells))
    title = f"Ratios of PD by {column}, geometric means"
    return Table(title, (column, *(style.title for style in styles.values())), tuple(lines))


def _misses(evaluation: Evaluation, method: str, rows: Sequence[Row]) -> str:
    asked = evaluation.experiment.get("methods")
    about = asked.get(method) if isinstance(asked, Mapping) else None
    if not isinstance(about, Mapping) or about.get("name") not in _ENERGY:
        return "-"
    return _share(value > MISSED for value in spread(rows, "best_cost").values)


def _quartiles(found: Spread) -> Cell:
    if not found.count:
        return Cell("-")
    lower, median, upper = found.quartiles
    return Cell(number(median), between=f"[{number(lower)}, {number(upper)}]")


def _share(flags: Iterable[bool]) -> str:
    listed = list(flags)
    return _percent(sum(listed) / len(listed)) if listed else "-"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if math.isfinite(share) else "-"


def _place(row: Row) -> Hashable:
    return (*trial_of(row), row["step"])
