"""The sections of a report on methods."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees
from typing import Any

import pandas as pd

from runners.evaluation.true_poses import true_poses
from runners.reporting.evaluation_folder import TRIAL, Evaluation, ReportError, trials_of
from runners.reporting.figures import Picture, Styles, boxes, curves, method_styles
from runners.reporting.page import Section
from runners.reporting.statistics import (
    DIVERSITY,
    LEAST_PD,
    geometric_mean,
    share_worse,
    shares,
    spreads,
    with_ratios,
)
from runners.reporting.tables import (
    Table,
    median_cells,
    method_table,
    number,
    percent,
    percent_range,
    table_of,
    with_range,
)
from runners.sessions.faults import CLEAN, LEVELS

_LAST_HALF = (
    "Numbers are pooled over trials (a configuration with a seed) and over the steps of the last "
    "half of every trial."
)
_FEW_METHODS = {  # name of the picture: title, text, methods
    "medial": (
        "The Medial Constraint with and without quality diversity",
        "What quality-diversity search brings to the objective of the Medial Constraint, beside "
        "CHSEL.",
        ("chsel", "medial_constraint", "medial_constraint_cma_me"),
    ),
    "cvo": (
        "CVO with and without free space",
        "What CVO gains or loses by free points, beside ICP, which never uses them.",
        ("icp", "cvo", "cvo_no_free_space"),
    ),
}
_FAULTY_COLUMNS = {  # title and unit of the table, factor
    "nearest_hypothesis": ("From the true pose to the nearest hypothesis, mm", 1e3),
    "position_error": ("Position error of the best hypothesis, mm", 1e3),
    DIVERSITY: ("PD in mm²", 1.0),
}
_ALL_LEVELS = "all levels"
_MOMENTS = {  # label of the axis, title of the table
    DIVERSITY: ("PD in mm²", "PD in mm² by iteration"),
    "mean_cost": ("mean relaxed cost of the best cells", "Mean cost by iteration"),
}
_OTHER_COST = "medial_constraint"  # methods that begin so search by another cost, in m^2


def sections_on_methods(evaluation: Evaluation, baseline: str | None = None) -> list[Section]:
    """What there is something to show of. Raises ReportError for a baseline without PD."""
    rows, half = evaluation.rows, evaluation.last_half
    styles = method_styles(evaluation.methods)
    sections = [_what_was_run(evaluation, styles), *_true_poses(evaluation)]
    if faulty := tables_by_faults(rows, styles):
        text = (
            "Sessions with faults have the probes of those without, see docs/faults.md; plausible "
            "sets are of the contacts without faults. All other sections pool the levels. "
            "Distances of hypotheses are root mean square distances between surfaces, so modulo "
            "symmetries."
        )
        sections.append(Section("Faults, and whether sets hold the truth", text, faulty))
    if baseline is not None:
        sections.append(against_baseline(evaluation, baseline))
    if rows[DIVERSITY].notna().any():
        sections += [_over_probes(rows, styles), _boxes(half, styles)]
    if rows["seconds"].notna().any():
        text = (
            "Wall-clock time of the registration alone on one thread, after a warm-up, over all "
            "trials and steps. Several workers on one machine slow each other down."
        )
        sections.append(Section("Time per registration", text, [times_table(rows, styles)]))
    moments = evaluation.iterations
    if moments[list(_MOMENTS)].notna().any(axis=None):
        sections.append(_over_iterations(moments, styles))
    sections += _of_few_methods(evaluation, styles)
    return [*sections, *_calibration(evaluation, styles)]


def _what_was_run(evaluation: Evaluation, styles: Styles) -> Section:
    rows, planned, lines = evaluation.rows, set(evaluation.planned_trials), []
    for method, style in styles.items():
        own = rows[rows["method"] == method]
        failed = own["status"].str.startswith("failed")
        done = trials_of(own[~failed])
        broken = trials_of(own[failed]) - done
        lines.append(
            {
                "method": style.title,
                "trials done": f"{len(done)} of {len(planned | done)}",
                "trials failed": len(broken),
                "trials missing": len(planned - done - broken),
                "registrations": int((~failed).sum()),
                "registrations failed": int(failed.sum()),
                "registrations without PD": int(own.loc[~failed, DIVERSITY].isna().sum()),
            }
        )
    objects = [
        {
            "object": name,
            "configurations": ", ".join(sorted(some["configuration"].unique())),
            "trials": len(trials_of(some)),
            "steps": len(some[some["step"].notna()].drop_duplicates([*TRIAL, "step"])),
        }
        for name, some in rows.groupby("object")
    ]
    bad = rows[rows["status"] != "ok"]
    failures = [
        {"configuration": name, "method": method, "registrations": len(some), "why": why}
        for (name, method, why), some in bad.groupby(["configuration", "method", "status"])
    ]
    text = (
        "A trial is a configuration with a seed. Its steps are the registrations after probes. "
        "What is missing or has failed is nowhere counted as a number."
    )
    tables = [
        table_of("What is there", lines),
        table_of("Objects", objects, labels=2),
        table_of("What failed", failures, labels=2),
    ]
    return Section("What was run", text, tables)


def _true_poses(evaluation: Evaluation) -> Iterator[Section]:
    """Where true poses of recorded sensors were sought."""
    text = (
        "The true pose of a recorded session is not known: it is the one of least evaluation cost "
        "near a pose that a person set (or, of a simulated log, its truth as roughly as a person "
        "would set it), by all that is known after the last probe. Plausible sets are made around "
        "it."
    )
    if (table := true_pose_table(evaluation)).rows:
        yield Section("True poses", text, [table])


def true_pose_table(evaluation: Evaluation) -> Table:
    """How well true poses fit, and how far they are from the guesses and a simulated truth."""
    found = pd.DataFrame(true_poses(evaluation.folder, evaluation.experiment))
    if found.empty:
        return table_of("True poses found", [])
    groups = [(str(name), some) for name, some in found.groupby("configuration", sort=False)]
    columns = {
        "mean |SDF| of contacts, mm": ("mean_distance", 1e3),
        "free points inside": ("violations", 1.0),
        "from the guess, mm": ("moved", 1e3),
        "from the guess, degrees": ("turned", degrees(1.0)),
        "from the simulated truth, mm": ("position_error", 1e3),
        "from the simulated truth, degrees": ("rotation_error", degrees(1.0)),
    }
    lines = []
    for name, some in [*groups, ("all", found)] if len(groups) > 1 else groups:
        line = {"configuration": name, "trials": len(some)}
        for heading, (column, factor) in columns.items():
            values = factor * some[column].astype(float)
            line[heading] = f"{number(values.mean())} [{number(values.max())}]"
        lines.append(line)
    note = (
        "Means over trials, and the greatest in brackets. Distances and angles between poses are "
        "modulo the object's symmetries, at its centre."
    )
    return table_of("True poses found", lines, note=note)


def tables_by_faults(rows: pd.DataFrame, styles: Styles) -> list[Table]:
    """Tables by level; none if no session had faults and no method has a set that holds poses."""
    levels = rows["faults"].fillna(CLEAN)
    order = [level for level in dict.fromkeys([*LEVELS, *levels]) if (levels == level).any()]
    rows = rows.assign(faults=levels)
    if len(order) > 1:
        rows = pd.concat([rows, rows.assign(faults=_ALL_LEVELS)])
    order.append(_ALL_LEVELS)
    rows = rows.assign(faults=pd.Categorical(rows["faults"], order, ordered=True))
    held = shares(rows, ["faults", "method"], "truth_held")
    if held.empty and set(levels) <= {CLEAN}:
        return []
    lines = []
    for level, found in held.groupby(level=0, observed=True):
        of_methods = found.droplevel(0)
        lines.append({"faults": str(level)})
        for method in [method for method in styles if method in held.index.unique("method")]:
            one = of_methods.loc[method] if method in of_methods.index else None
            text = "-" if one is None else f"{percent_range(one)} (n {one['total']:.0f})"
            lines[-1][styles[method].title] = text
    note = (
        "Intervals of 95 % (Wilson) as if steps were independent, which those of a session are "
        "not; a set is calibrated where the share is 95 %."
    )
    tables = [table_of("Steps with the true pose in the set", lines, note=note)]
    for column, (title, factor) in _FAULTY_COLUMNS.items():
        scaled = rows.assign(**{column: factor * rows[column]})
        some = scaled.groupby("faults", observed=True)[column].transform("count") > 0
        tables.append(method_table(title, scaled[some], "faults", styles, column=column))
    return [table for table in tables if table.rows]


def against_baseline(evaluation: Evaluation, baseline: str) -> Section:
    """Tables of all methods beside one of them. Raises ReportError if that has no PD."""
    rows, styles = with_ratios(evaluation.rows, baseline), method_styles(evaluation.methods)
    if rows["ratio"].isna().all():
        known = ", ".join(sorted(rows["method"].unique()))
        raise ReportError(f"baseline {baseline} has no PD; accepted: {known}")
    lines = []
    for method, style in styles.items():
        own = rows[rows["method"] == method]
        diversity, distinct = own[DIVERSITY], own["distinct"].dropna().astype(float)
        left_out = diversity.isna().sum()
        lower, median, upper = diversity.quantile([0.25, 0.5, 0.75])
        lines.append(
            {
                "method": style.title,
                "n": f"{diversity.count()}" + (f" ({left_out} left out)" if left_out else ""),
                "PD in mm², median [quartiles]": with_range(median, lower, upper),
                "geometric mean": geometric_mean(own["floored"]),
                f"ratio to {baseline}": geometric_mean(own["ratio"]),
                "worse": "-" if method == baseline else percent(share_worse(own["ratio"])),
                "members": percent(own["exact_members"].mean()),
                "distinct [least]": f"{number(distinct.mean())} [{number(distinct.min())}]",
                "s, median": float(own["seconds"].median()),
                "s, mean": float(own["seconds"].mean()),
            }
        )
    note = (
        "Ratio: the geometric mean of all. Members: the mean share of hypotheses that are members "
        f"of the plausible set by its definition, {evaluation.definition_text}. Distinct: poses, "
        "on average."
    )
    title = f"PD and its ratios over all registrations, by {evaluation.definition}"
    tables = [table_of(title, lines, note=note)]
    for by in ("object", "step"):
        found = rows.groupby([by, "method"])["ratio"].agg(geometric_mean).unstack()
        found = found.reindex(columns=list(styles)).set_axis(
            [style.title for style in styles.values()], axis=1
        )
        of_groups = [{by: str(value), **ratios} for value, ratios in found.to_dict("index").items()]
        tables.append(table_of(f"Ratios of PD by {by}, geometric means", of_groups))
    text = (
        "Over all registrations: every step of every trial, and every draw, that is the same "
        f"session registered with other random numbers. A ratio is PD by that of {baseline} at the "
        "same trial and step, by the geometric mean of its draws where there are several; worse "
        f"is a ratio above 1. PD below {LEAST_PD:g} mm² counts as {LEAST_PD:g} mm² in geometric "
        "means and ratios. What has failed has no PD and is left out, n says of how many numbers."
    )
    return Section(f"All methods beside {baseline}", text, tables)


def _over_probes(rows: pd.DataFrame, styles: Styles) -> Section:
    text = (
        "Median (line) and 25th to 75th percentile (band) over the trials of an object, all of "
        "its configurations and seeds, at every step. Lower is better. Configurations have more "
        "or fewer probes, so that first and last steps are of some trials only."
    )
    tables = [
        method_table(f"PD in mm² of {name} by step", some, "step", styles)
        for name, some in rows[rows["step"].notna()].groupby("object")
    ]
    picture = pd_over_probes("pd_over_probes", rows, styles)
    return Section("Plausible diversity over the probes", text, tables, picture)


def pd_over_probes(name: str, rows: pd.DataFrame, styles: Styles) -> Picture:
    """Medians and quartiles of PD at every step, by object and method."""
    rows = rows[rows["method"].isin(list(styles)) & rows[DIVERSITY].notna()]
    found = spreads(rows, ["object", "method", "step"], DIVERSITY).reset_index()
    data = found[["object", "method", "step", "count", "lower", "median", "upper"]]
    titles = ", ".join(style.title for style in styles.values())
    return curves(
        name,
        f"Plausible diversity over probes of {titles}, medians and quartiles by object.",
        data,
        styles,
        x="step",
        y="median",
        by="method",
        panel="object",
        labels=("step (index of the probe)", "PD in mm²"),
    )


def _boxes(half: pd.DataFrame, styles: Styles) -> Section:
    text = (
        f"{_LAST_HALF} Boxes span the 25th to the 75th percentile, lines across are medians; "
        "whiskers reach the least and greatest numbers apart from outliers, which are diamonds "
        "(farther than 1.5 boxes from the box). Lower is better."
    )
    tables = [method_table(f"PD in mm² by {by}", half, by, styles) for by in ("object", TRIAL[0])]
    titles = ", ".join(style.title for style in styles.values())
    keys = ["object", *TRIAL, "method", "step", "draw"]
    picture = boxes(
        "pd_boxes",
        f"Box plots of plausible diversity by object, a box for each of {titles}.",
        half.loc[half[DIVERSITY].notna(), [*keys, DIVERSITY]],
        styles,
        y=DIVERSITY,
        by="method",
        panel="object",
        label="PD in mm²",
    )
    return Section("Plausible diversity by object and method", text, tables, picture)


def times_table(rows: pd.DataFrame, styles: Styles) -> Table:
    """Milliseconds of a registration, a row for every method."""
    found = spreads(rows.assign(ms=1e3 * rows["seconds"]), "method", "ms").query("count > 0")
    found = found.reindex([method for method in styles if method in found.index])
    cells = median_cells(found.assign(left_out=0, count=1), "min")
    lines: list[dict[str, Any]] = []
    for (method, of), median in zip(found.iterrows(), cells, strict=True):
        counts = {"registrations": int(of["count"]), "without time": int(of["left_out"])}
        line = {"mean": of["mean"], "deviation": of["deviation"], "median [quartiles]": median}
        lines.append({"method": styles[str(method)].title, **line, **counts})
    return table_of("Time per registration in ms", lines)


def _over_iterations(moments: pd.DataFrame, styles: Styles) -> Section:
    text = (
        "What a method would give if its search ended after so many iterations: PD of the "
        "hypotheses, and the mean cost of the best cells, from which these are taken. Medians and "
        "25th to 75th percentiles over trials and steps; all searches of a trial and step start "
        f"alike. Of {', '.join(sorted(moments['configuration'].unique()))}."
    )
    tables, parts = [], []
    for column, (_, title) in _MOMENTS.items():
        rows = moments[moments[column].notna()]
        if column == "mean_cost":
            rows = rows[~rows["method"].str.startswith(_OTHER_COST)]
        shown = {method: s for method, s in styles.items() if (rows["method"] == method).any()}
        tables.append(method_table(title, rows, "iteration", shown, column=column))
        found = spreads(rows, ["method", "iteration"], column).reset_index()
        parts.append(found.assign(number=column))
    data = pd.concat(parts)[["number", "method", "iteration", "count", "lower", "median", "upper"]]
    picture = curves(
        "over_iterations",
        "Plausible diversity and mean cost over iterations, medians and quartiles by method.",
        data,
        styles,
        x="iteration",
        y="median",
        by="method",
        panel="number",
        labels=("QD iterations", {column: label for column, (label, _) in _MOMENTS.items()}),
    )
    return Section("Plausible diversity and cost over QD iterations", text, tables, picture)


def _of_few_methods(evaluation: Evaluation, styles: Styles) -> Iterator[Section]:
    """PD over the probes of two or three methods that belong together."""
    rows, half = evaluation.rows, evaluation.last_half
    known = set(rows.loc[rows[DIVERSITY].notna(), "method"])
    for name, (title, text, methods) in _FEW_METHODS.items():
        some = {method: styles[method] for method in methods if method in known}
        if len(some) > 1:
            own = half[half["method"].isin(list(some))]
            heading = "PD in mm² by object, of these methods"
            table = method_table(heading, own, "object", some, note=_LAST_HALF)
            yield Section(title, text, [table], pd_over_probes(name, rows, some))


def _calibration(evaluation: Evaluation, styles: Styles) -> Iterator[Section]:
    """The rank of the true pose among the hypotheses, and how many hypotheses are plausible."""
    half = evaluation.last_half
    rank = method_table(
        "Rank of the true pose among the hypotheses",
        half[half["rank"].notna()],
        "object",
        styles,
        column="rank",
        best=None,
        note="Uniform in (0, 1], so 0.5 in the median, for a set that spreads as far as it errs; "
        "small ones say that the truth is outside of it.",
    )
    members = method_table(
        "Share of hypotheses in the plausible set",
        half[half["exact_members"].notna()],
        "object",
        styles,
        column="exact_members",
        best="max",
        note="Of hypotheses that fulfil the definition of the plausible set themselves, "
        f"{evaluation.definition}; 1 is best.",
    )
    if rank.rows or members.rows:
        yield Section("Calibration and membership", _LAST_HALF, [rank, members])
