"""The sections of a report: which tables and pictures show what of methods, and of policies."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from math import degrees
from typing import Any

import pandas as pd

from chsel.errors import SettingError
from runners.reporting import statistics
from runners.reporting.evaluation_folder import TRIAL, Evaluation, last_half, trials_of
from runners.reporting.figures import Picture, Styles, boxes, curves, styles_of
from runners.reporting.page import Section
from runners.reporting.statistics import (
    DIVERSITY,
    GOOD,
    LEAST_ERROR,
    LEAST_PD,
    SteeredSessions,
    geometric_mean,
    shares,
)
from runners.reporting.tables import (
    Table,
    bold_best,
    median_cells,
    method_table,
    number,
    percent,
    percent_range,
    pivot_table,
    table_of,
    with_range,
)
from runners.sessions.faults import CLEAN, LEVELS

_MM = 1000.0
_LIMITS = (0.020, GOOD, 0.005)  # metres: errors of a set
_STOP_SPREADS = (0.020, 0.010, 0.005)  # metres
_STOP_FACTOR = 1.5  # of the spread at which a session stops; an error above is a wrong stop
_ALL, _ALL_LEVELS = "all", "all levels"
_PD = "PD in mm²"
_RUN, BASELINE = "What was run", "All methods beside the baseline"
_TRUTH_HELD = "Whether sets hold the truth"
_FAULTS = "Faults, and whether sets hold the truth"
_MEDIAL = "The Medial Constraint with and without quality diversity"
_CVO = "CVO with and without free space"
_OF_A_FEW = "Plausible diversity as in the sections on all methods, of these methods alone."
_BUSY = "on one thread, after a warm-up. Several workers on one machine slow each other down."
_LAST_HALF = (
    "Numbers are pooled over trials (a configuration with a seed) and over the steps of the last "
    "half of every trial."
)
_TEXTS = {  # of sections, by title
    _RUN: "A trial is a configuration with a seed. What has failed is nowhere counted as a number.",
    "True poses": "The true pose of a recorded session is the one of least evaluation cost, after "
    "the last probe, near a pose that a person set (of a simulated log: its rounded truth).",
    _TRUTH_HELD: "Of methods that say which poses they cannot tell from their best one.",
    _FAULTS: "Plausible sets are of the contacts without faults, "
    "see docs/faults.md. All other sections pool the levels. Distances are between surfaces.",
    BASELINE: "Over every step of every trial and draw. A ratio is PD by that of {baseline} at the "
    "same trial and step, by the geometric mean of its draws; worse is a ratio above 1. In ratios "
    f"and geometric means PD is at least {LEAST_PD:g} mm².",
    "Plausible diversity over the probes": "Median (line) and quartiles (band) over the trials of "
    "an object. Lower is better. First and last steps are of some trials only.",
    "Plausible diversity by object and method": f"{_LAST_HALF} Boxes span the quartiles, lines "
    "across are medians; whiskers reach to the last numbers within 1.5 boxes. Lower is better.",
    _MEDIAL: _OF_A_FEW,
    _CVO: _OF_A_FEW,
    "Time per registration": f"Wall-clock time of the registration alone {_BUSY}",
    "Plausible diversity and cost over QD iterations": "What a method would give if its search "
    "ended there, medians and quartiles over trials and steps, of which each has one start.",
    "Calibration and membership": _LAST_HALF,
    "Error and spread over probes": "Error: root mean square distance of the object's surfaces in "
    "a hypothesis and in the true pose, on average over the set; before the first contact, of the "
    "poses that the free space allows. Spread: the same between two poses of the belief. Geometric "
    "means over the {count} trials that all policies have finished ({left_out} are left out), with "
    "95 % intervals by a bootstrap over configurations, or over sessions if these are few; errors "
    f"below {_MM * LEAST_ERROR:g} mm count as {_MM * LEAST_ERROR:g} mm.",
    "Probes needed": "After how many probes the error of the set first is below a limit. A session "
    "that does not get there within {budget} probes counts as needing more (Kaplan-Meier). A "
    f"session is solvable if any policy gets below {_MM * GOOD:g} mm in it.",
    "Policies compared, session by session": "Errors of the set after {compared} probes, and their "
    "ratios to those of {reference} in the same trial: above 1 the latter is better.",
    "Calibration of forecasts and of stopping": "Hits: the chance that was forecast for the chosen "
    "probe, and how often such probes met the object. Stops: the first probe with so small a "
    f"spread of the belief; good if the error then is at most {_STOP_FACTOR:g} times it.",
    "Calibration of beliefs": "Members of registrations of all policies, as `session.belief` has "
    "them. Of 40 grasps drawn at members the best is taken, of the size of a Franka Panda hand.",
    "Time per decision and registration": "Wall-clock time of choosing the next probe, of the "
    f"registration before it, and of both together, {_BUSY}",
}
_FEW_METHODS = {  # name of the picture: title of the section, methods
    "medial": (_MEDIAL, ("chsel", "medial_constraint", "medial_constraint_cma_me")),
    "cvo": (_CVO, ("icp", "cvo", "cvo_no_free_space")),
}
_FAULTY_COLUMNS = {  # title and unit of the table, factor
    "nearest_hypothesis": ("From the true pose to the nearest hypothesis, mm", _MM),
    "position_error": ("Position error of the best hypothesis, mm", _MM),
    DIVERSITY: (_PD, 1.0),
}
_NEAR = {  # by column
    "precision": "Precision: share of hypotheses within 10 mm of a plausible pose",
    "recall": "Recall: share of plausible poses with a hypothesis within 10 mm",
}
_MOMENTS = {DIVERSITY: _PD, "mean_cost": "mean relaxed cost of the best cells"}
_OTHER_COST = "medial_constraint"  # methods that begin so search by another cost, in m^2
_QUARTILES = ["count", "lower", "median", "upper"]
_BOXED = ["object", "method", *TRIAL, "step", "draw", DIVERSITY]
_TRUE_POSES = {  # heading: number of a session.json, factor
    "mean |SDF| of contacts, mm": ("mean_distance", _MM),
    "free points inside": ("violations", 1.0),
    "from the guess, mm": ("from_guess.position", _MM),
    "from the guess, degrees": ("from_guess.rotation", degrees(1.0)),
    "from the simulated truth, mm": ("from_known.position", _MM),
    "from the simulated truth, degrees": ("from_known.rotation", degrees(1.0)),
}
_CONTACTS = (1, 4), (5, 8), (9, 12), (13, 99)  # of a registration
_MIDDLES = {"middle_50": "in the middle 50 %", "middle_90": "in the middle 90 %"}
_OVER_PROBES = {"error": "error of the set, mm", "spread": "spread of the belief, mm"}

Part = tuple[str, Sequence[Table], Picture | None]  # title, tables, picture of a section


def sections_of(evaluation: Evaluation, baseline: str | None = None) -> list[Section]:
    """Return the sections of a report: what was run, and those that have a table with rows.

    Raise SettingError for a baseline without PD, or of policies without a session.
    """
    on = _on_policies if evaluation.experiment["policies"] else _on_methods
    parts, numbers = on(evaluation, baseline)
    every = [
        Section(title, _TEXTS[title].format(**numbers), tables=tables, picture=picture)
        for title, tables, picture in parts
    ]
    return [
        section
        for section in every
        if section.title == _RUN or any(table.rows for table in section.tables)
    ]


def _on_methods(
    evaluation: Evaluation, baseline: str | None
) -> tuple[Sequence[Part], Mapping[str, object]]:
    rows = evaluation.rows
    moments = evaluation.iterations
    styles = styles_of(evaluation.methods)
    measured = rows if rows[DIVERSITY].notna().any() else rows[:0]
    half, measured_half = last_half(rows), last_half(measured)
    by_step = [
        method_table(f"PD in mm² of {name} by step", some, by="step", styles=styles)
        for name, some in measured[measured["step"].notna()].groupby("object")
    ]
    by_place = [
        method_table(f"PD in mm² by {by}", measured_half, by=by, styles=styles)
        for by in ("object", "configuration")
    ]
    boxed = boxes("pd_boxes", half.loc[half[DIVERSITY].notna(), _BOXED], styles=styles, label=_PD)
    beside = [] if baseline is None else against_baseline(evaluation, baseline)
    over_probes = pd_over_probes("pd_over_probes", rows, styles=styles)
    parts: list[Part] = [
        (_RUN, _what_was_run(evaluation, rows, by="method", styles=styles), None),
        ("True poses", [true_pose_table(evaluation)], None),
        (_FAULTS if has_faults(rows) else _TRUTH_HELD, tables_by_faults(rows, styles), None),
        (BASELINE, beside, None),
        ("Plausible diversity over the probes", by_step, over_probes),
        ("Plausible diversity by object and method", by_place, boxed),
        ("Time per registration", [_times_table(rows, styles)], None),
        _over_iterations(moments, styles),
    ]
    known = set(rows.loc[rows[DIVERSITY].notna(), "method"])
    for name, (title, methods) in _FEW_METHODS.items():
        some = {key: styles[key] for key in methods if key in known}
        if len(some) > 1:
            own = half[half["method"].isin(list(some))]
            tables = [
                method_table("PD in mm² by object, of these methods", own, by="object", styles=some)
            ]
            parts.append((title, tables, pd_over_probes(name, rows, styles=some)))
    parts.append(("Calibration and membership", _calibration(half, styles), None))
    return parts, {"baseline": baseline}


def short_tables(evaluation: Evaluation) -> list[Table]:
    """Return the tables that are shown of an evaluation that has just ended."""
    rows = evaluation.rows
    if not evaluation.experiment["policies"]:
        styles = styles_of(evaluation.methods)
        note = f"Over all steps of all trials. Plausible sets: {evaluation.definition_text}."
        medians = method_table("PD in mm² by object", rows, by="object", styles=styles, note=note)
        faults = tables_by_faults(rows, styles)
        return [medians, _times_table(rows, styles), *faults, true_pose_table(evaluation)]
    sessions = statistics.steered_sessions(evaluation)
    styles = styles_of(evaluation.experiment["policies"])
    return [error_table(sessions, styles), needed_table(sessions, styles)] * bool(sessions.count)


def _what_was_run(
    evaluation: Evaluation, rows: pd.DataFrame, *, by: str, styles: Styles
) -> list[Table]:
    """Return tables of methods or policies, as `by` says: trials, and rows by status."""
    planned, lines = {*evaluation.planned_trials}, []
    kinds = rows["status"].str.replace(r":.*", "", regex=True)
    for name, style in styles.items():
        own = rows[by] == name
        done = trials_of(rows[own & (kinds != "failed")])
        broken = trials_of(rows[own & (kinds == "failed")]) - done
        line: dict[str, Any] = {by: style.title}
        line["trials done"] = f"{len(done)} of {len(planned | done)}"
        line |= {"trials failed": len(broken), "trials missing": len(planned - done - broken)}
        lines.append(line | {kind: int((kinds[own] == kind).sum()) for kind in sorted({*kinds})})
    bad = rows[rows["status"] != "ok"].groupby(["configuration", by, "status"]).size()
    names = ["configuration", by, "why", "rows"]
    failures = [dict(zip(names, (*keys, count), strict=True)) for keys, count in bad.items()]
    failed = table_of("What failed", failures, labels=3)
    return [table_of("What is there", lines), failed]


def true_pose_table(evaluation: Evaluation) -> Table:
    """Return how well true poses of sensors' logs fit, and their distance to guess and truth."""
    truths, lines = [], []
    for configuration, seed in evaluation.planned_trials:
        path = evaluation.folder / "trials" / configuration / f"seed_{seed}" / "session.json"
        if path.exists() and (truth := json.loads(path.read_text()).get("truth")):
            truths.append({**truth, "configuration": configuration})
    found = pd.json_normalize(truths)
    groups = list(found.groupby("configuration", sort=False)) if truths else []
    for name, some in [*groups, (_ALL, found)] if len(groups) > 1 else groups:
        line = {"configuration": str(name), "trials": len(some)}
        for heading, (column, factor) in _TRUE_POSES.items():
            values = factor * some.get(column, pd.Series(dtype=float))
            line[heading] = f"{number(values.mean())} [{number(values.max())}]"
        lines.append(line)
    note = "Means [greatest] over trials; between poses at the centre, modulo symmetries."
    return table_of("True poses found", lines, note=note)


def has_faults(rows: pd.DataFrame) -> bool:
    """Return whether a session of these rows had faults."""
    return not set(rows["faults"].dropna()) <= {CLEAN}


def tables_by_faults(rows: pd.DataFrame, styles: Styles) -> list[Table]:
    """Return tables by level; without faults whether sets hold the truth, if a method says so."""
    levels = rows["faults"].fillna(CLEAN)
    order = [level for level in dict.fromkeys([*LEVELS, *levels]) if (levels == level).any()]
    rows = rows.assign(faults=levels)
    if len(order) > 1:
        rows = pd.concat([rows, rows.assign(faults=_ALL_LEVELS)])
    order.append(_ALL_LEVELS)
    rows = rows.assign(faults=pd.Categorical(rows["faults"], order, ordered=True))
    held = shares(rows, ["faults", "method"], column="truth_held")
    if held.empty and set(levels) <= {CLEAN}:
        return []
    texts = [f"{percent_range(of)} (n {of['total']:.0f})" for _, of in held.iterrows()]
    cells = pd.Series(texts, held.index, dtype=object).unstack()
    having = {key: style for key, style in styles.items() if key in cells}
    note = "95 % intervals (Wilson) as if steps were independent; calibrated sets have 95 %."
    tables = [pivot_table("Steps with the true pose in the set", cells, styles=having, note=note)]
    if set(levels) <= {CLEAN}:
        return tables
    for column, (title, factor) in _FAULTY_COLUMNS.items():
        scaled = rows.assign(**{column: factor * rows[column]})
        some = scaled.groupby("faults", observed=True)[column].transform("count") > 0
        tables.append(method_table(title, scaled[some], by="faults", styles=styles, column=column))
    return tables


def against_baseline(evaluation: Evaluation, baseline: str) -> list[Table]:
    """Return tables of all methods beside one; raise SettingError if that has no PD."""
    rows = statistics.with_ratios(evaluation.rows, baseline)
    styles = styles_of(evaluation.methods)
    if rows["ratio"].isna().all():
        known = ", ".join(sorted(rows["method"].unique()))
        raise SettingError(f"baseline {baseline} has no PD; accepted: {known}")
    lines = []
    for method, style in styles.items():
        own = rows[rows["method"] == method]
        diversity = own[DIVERSITY]
        distinct = own["distinct"].dropna().astype(float)
        left_out = diversity.isna().sum()
        lower, median, upper = diversity.quantile([0.25, 0.5, 0.75])
        lower = lower if diversity.count() > 1 else math.nan  # one number has no quartiles
        # The rounding of a geometric mean makes no PD worse.
        worse = percent((own["ratio"].dropna() > 1.0 + 1e-9).mean())
        mean, least, most = statistics.ratio_interval(own)
        lines.append(
            {
                "method": style.title,
                "n": f"{diversity.count()}" + (f" ({left_out} left out)" if left_out else ""),
                "PD in mm², median [quartiles]": with_range(median, lower, upper=upper),
                "geometric mean": geometric_mean(own["floored"]),
                f"ratio to {baseline} [95 %]": with_range(mean, lower=least, upper=most),
                "worse": "-" if method == baseline else worse,
                "members": percent(own["exact_members"].mean()),
                "precision": percent(own["precision"].mean()),
                "recall": percent(own["recall"].mean()),
                "distinct [least]": f"{number(distinct.mean())} [{number(distinct.min())}]",
                "s, median": float(own["seconds"].median()),
                "s, mean": float(own["seconds"].mean()),
            }
        )
    note = (
        f"Members: mean share of hypotheses in the plausible set, {evaluation.definition_text}. "
        "Precision: mean share of hypotheses within 10 mm of one of its poses; recall: mean share "
        "of its poses with such a hypothesis. "
        "Intervals by a bootstrap over configurations, or over sessions if these are few."
    )
    tables = [table_of("PD and its ratios over all registrations", lines, note=note)]
    for by in ("object", "step"):
        found = rows.groupby([by, "method"])["ratio"].agg(geometric_mean).map(number).unstack()
        tables.append(pivot_table(f"Ratios of PD by {by}, geometric means", found, styles=styles))
    return tables


def pd_over_probes(name: str, rows: pd.DataFrame, *, styles: Styles) -> Picture | None:
    """Return medians and quartiles of PD at every step, by object and method."""
    rows = rows[rows["method"].isin(list(styles)) & rows[DIVERSITY].notna()]
    found = statistics.spreads(rows, ["object", "method", "step"], column=DIVERSITY).reset_index()
    data = found[["object", "method", "step", *_QUARTILES]]
    return curves(name, data, styles=styles, across="step (index of the probe)", up=_PD)


def _times_table(rows: pd.DataFrame, styles: Styles) -> Table:
    """Return milliseconds of a registration, a row for every method."""
    found = statistics.spreads(rows.assign(ms=_MM * rows["seconds"]), "method", column="ms")
    found = found.query("count > 0").reindex(list(styles)).dropna().astype({"count": int})
    cells = median_cells(found.assign(left_out=0, count=1), "min")
    lines = found.assign(method=[styles[str(key)].title for key in found.index], median=cells)
    lines = lines[["method", "mean", "deviation", "median", "count"]]
    lines = lines.rename(columns={"median": "median [quartiles]", "count": "registrations"})
    return table_of("Time per registration in ms", lines.to_dict("records"))


def _over_iterations(moments: pd.DataFrame, styles: Styles) -> Part:
    tables, parts = [], []
    for column, label in _MOMENTS.items():
        rows = moments[moments[column].notna()]
        if column == "mean_cost":
            rows = rows[~rows["method"].str.startswith(_OTHER_COST)]
        shown = {key: s for key, s in styles.items() if (rows["method"] == key).any()}
        title = f"{label} by iteration"
        tables.append(method_table(title, rows, by="iteration", styles=shown, column=column))
        found = statistics.spreads(rows, ["method", "iteration"], column=column).reset_index()
        parts.append(found.assign(number=column))
    data = pd.concat(parts)[["number", "method", "iteration", *_QUARTILES]]
    picture = curves("over_iterations", data, styles=styles, across="QD iterations", up=_MOMENTS)
    return "Plausible diversity and cost over QD iterations", tables, picture


def _calibration(half: pd.DataFrame, styles: Styles) -> list[Table]:
    """Return the rank of the true pose among hypotheses, and how many of these are plausible."""
    ranks, members = half[half["rank"].notna()], half[half["exact_members"].notna()]
    note = "0.5 in the median for a set that spreads as far as it errs; small: the truth is outside"
    title = "Rank of the true pose among the hypotheses"
    share = "Share of hypotheses in the plausible set"
    tables = [
        method_table(title, ranks, by="object", styles=styles, column="rank", note=note),
        method_table(share, members, by="object", styles=styles, column="exact_members"),
    ]
    for column, text in _NEAR.items():
        own = half[half[column].notna()]
        tables.append(method_table(text, own, by="object", styles=styles, column=column))
    return tables


def _on_policies(
    evaluation: Evaluation, reference: str | None
) -> tuple[Sequence[Part], Mapping[str, object]]:
    sessions = statistics.steered_sessions(evaluation, reference)
    every = styles_of(evaluation.experiment["policies"])
    styles = {policy: every[policy] for policy in sessions.policies}
    run = (_RUN, _what_was_run(evaluation, evaluation.probes, by="policy", styles=every), None)
    if sessions.count == 0:
        return [run], {}
    numbers = {
        "count": sessions.count,
        "left_out": sessions.left_out,
        "budget": sessions.budget,
        "compared": sessions.compared,
        "reference": styles[sessions.reference].title,
    }
    spread = _means_table(sessions, styles, column="spread", title="Spread of the belief, mm")
    errors = [error_table(sessions, styles), spread]
    calibrated = [*_hit_tables(sessions, styles), _stops_table(sessions, styles)]
    beliefs = _belief_tables(sessions)
    parts = [
        run,
        ("Error and spread over probes", errors, _means_over_probes(sessions, every)),
        ("Probes needed", [needed_table(sessions, styles)], None),
        ("Policies compared, session by session", _compared(sessions, styles), None),
        ("Calibration of forecasts and of stopping", calibrated, None),
        ("Calibration of beliefs", beliefs, None),
        ("Time per decision and registration", [_decision_times(sessions.rows, styles)], None),
    ]
    return parts, numbers


def error_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Return geometric means of the errors after so many probes, mm."""
    return _means_table(
        sessions, styles, column="error", title="Error of the set after so many probes, mm"
    )


def _means_table(sessions: SteeredSessions, styles: Styles, *, column: str, title: str) -> Table:
    means = _MM * statistics.geometric_means(sessions.over_probes(column)).loc[sessions.policies]
    shown = [n for n in means.columns if n <= 2 or n % 2 == 0 or n == sessions.budget]
    columns = {str(n): _bold(means[n]) for n in shown}
    lines = [
        {"policy": styles[policy].title, **{n: cells[index] for n, cells in columns.items()}}
        for index, policy in enumerate(means.index)
    ]
    return table_of(title, lines, note=f"Geometric means over {sessions.count} sessions.")


def _means_over_probes(sessions: SteeredSessions, styles: Styles) -> Picture | None:
    """Return errors and spreads with their intervals, mm."""
    data = pd.concat([statistics.means_with_intervals(sessions, name) for name in _OVER_PROBES])
    data[["lower", "mean", "upper"]] *= _MM
    return curves("error_over_probes", data, styles=styles, across="probes", up=_OVER_PROBES)


def needed_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Return median [quartiles] of the probes to each limit, and shares of sessions within it."""
    lines = []
    for policy in sessions.policies:
        errors = sessions.errors.loc[policy]
        needed = statistics.first_below(errors, GOOD)
        solvable = needed[needed.index.isin(sessions.solvable)]
        line = {"policy": styles[policy].title}
        for limit in _LIMITS:
            there = statistics.first_below(errors, limit)
            line[f"to {_MM * limit:g} mm"] = _quartiles(there, sessions.budget)
        line[f"below {_MM * GOOD:g} mm"] = _share(needed < math.inf)
        line["of solvable"] = _share(solvable < math.inf)
        line["to there, of solvable"] = _quartiles(solvable, sessions.budget)
        lines.append(line)
    note = (
        f"Medians [quartiles] of probes over {sessions.count} sessions, of which "
        f"{len(sessions.solvable)} are solvable; intervals of shares are of 95 % (Wilson)."
    )
    return table_of("Probes until the error of the set is below a limit", lines, note=note)


def _quartiles(needed: pd.Series, budget: int) -> str:
    numbers = [statistics.censored_quantile(needed, share) for share in (0.25, 0.5, 0.75)]
    lower, median, upper = (f"{n:.0f}" if math.isfinite(n) else f">{budget}" for n in numbers)
    return f"{median} [{lower}, {upper}]" if len(needed) else "-"


def _share(flags: pd.Series) -> str:
    """Return the share of the flags that are set, with its interval."""
    found = shares(pd.DataFrame({_ALL: 0, "flag": flags}), _ALL, column="flag")
    return percent_range(found.iloc[0]) if len(found) else "-"


def _compared(sessions: SteeredSessions, styles: Styles) -> list[Table]:
    """Return tables of every policy beside the reference, by session and by configuration."""
    if len(styles) < 2:
        return []
    reference, lines = styles[sessions.reference].title, []
    for policy in [policy for policy in sessions.policies if policy != sessions.reference]:
        of = statistics.paired(sessions, policy)
        line = {"policy": styles[policy].title, "sessions": of["sessions"]}
        line |= {f"{reference} better": of["wins"], "worse": of["losses"]}
        line |= {"sign test, p": f"{of['sign_test']:.2g}", "ratio, median": of["median"]}
        mean = with_range(of["mean"], of["lower"], upper=of["upper"])
        lines.append(line | {"ratio, geometric mean [95 %]": mean})
    note = "Intervals by a bootstrap over configurations, or over sessions if these are few."
    title = f"Error beside {reference} after {sessions.compared} probes"
    tables = [table_of(title, lines, note=note)]
    ratios = statistics.ratios_to_best(sessions).dropna()
    line = {"": "ratio", **{str(n): f"{ratio:.2f}" for n, ratio in ratios.items()}}
    title = f"Error of {sessions.reference} by that of the best other policy"
    note = "Ratios of geometric means after so many probes; below 1 is better than all others."
    tables.append(table_of(title, [line | {"largest": f"{ratios.max():.2f}"}], note=note))
    for by in ("configuration", "faults"):
        if by == "configuration" or sessions.rows[by].nunique() > 1:
            tables.append(_by_table(sessions, styles, by=by))
    return tables


def _by_table(sessions: SteeredSessions, styles: Styles, *, by: str) -> Table:
    """Return geometric means of the errors by what a column of the rows holds, mm."""
    cells, counts = {}, {}
    for value, some in sessions.rows.groupby(by):
        trials = pd.MultiIndex.from_frame(some[TRIAL].drop_duplicates())
        own = sessions.errors[sessions.errors.index.droplevel("policy").isin(trials)]
        means = _MM * statistics.geometric_means(own).loc[sessions.policies, sessions.compared]
        cells[value], counts[value] = _bold(means), len(trials)
    frame = pd.DataFrame.from_dict(cells, "index", columns=sessions.policies).rename_axis(by)
    title = f"Error after {sessions.compared} probes by {by}, mm"
    note = "Geometric means over n sessions of a policy."
    return pivot_table(title, frame, styles=styles, counts=counts, note=note)


def _bold(means: pd.Series) -> list[str]:
    return bold_best(means.tolist(), means.map(number).tolist())


def _hit_tables(sessions: SteeredSessions, styles: Styles) -> list[Table]:
    """Return tables of hits beside their forecast chances."""
    rows, lines = sessions.forecasts, []
    groups = {styles[policy].title: rows["policy"] == policy for policy in sessions.policies}
    groups["all, before the first contact"] = ~rows["touched"]
    groups["all, after it"], groups[_ALL] = rows["touched"], rows["hit"].notna()
    for title, flags in groups.items():
        own = 100.0 * rows.loc[flags, ["hit_forecast", "hit"]]
        if len(own):
            forecast, happened = own.mean()
            texts = {"forecast": f"{forecast:.1f}", "happened": f"{happened:.1f}"}
            texts["difference, points"] = f"{forecast - happened:+.1f}"
            lines.append({"policy": title, "probes": len(own), **texts})
    means = table_of("Chance of a hit, forecast and happened, %", lines)
    bins = _tenths(rows, "hit_forecast", happened="hit", counted="probes")
    return [means, table_of("Hits by their forecast, all policies", bins)]


def _tenths(
    rows: pd.DataFrame, forecast: str, *, happened: str, counted: str
) -> list[dict[str, Any]]:
    """Return a line for every tenth of a chance, with what happened."""
    lines = []
    for tenth, of in statistics.by_tenths(rows, forecast, happened=happened).iterrows():
        line = {"forecast": f"{10 * tenth} to {10 * tenth + 10} %", counted: int(of["total"])}
        line["mean forecast"] = f"{100.0 * of['forecast']:.0f} %"
        lines.append(line | {"happened [95 %]": percent_range(of)})
    return lines


def _belief_tables(sessions: SteeredSessions) -> list[Table]:
    """Return how often beliefs have the true pose, by how hard that is, and grasps work."""
    rows = sessions.rows[sessions.rows["grasp_chance"].notna()]
    by_contacts = {
        f"{first} to {last}": rows[rows["contacts"].between(first, last)]
        for first, last in _CONTACTS
    }
    contacts = [
        {"contacts": name, **_belief_cells(own)} for name, own in by_contacts.items() if len(own)
    ]
    quarters = pd.qcut(_MM * rows["spread"], 4, duplicates="drop")
    spreads = [
        {"spread, mm": f"{quarter.left:.1f} to {quarter.right:.1f}", **_belief_cells(own)}
        for quarter, own in rows.groupby(quarters, observed=True)
    ]
    bins = _tenths(rows, "grasp_chance", happened="grasp_works", counted="grasps")
    note = (
        "The true pose along the three directions in which members spread the most, and in the "
        "widened ellipsoid of 90 % of a mode, where a result has modes."
    )
    return [
        table_of("Beliefs by the number of contacts", contacts, note=note),
        table_of("Beliefs by quarter of their spread", spreads, note=note),
        table_of("Grasps by the chance that they work", bins),
    ]


def _belief_cells(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the beliefs of some registrations say, and what is true."""
    cells: dict[str, Any] = {"registrations": len(rows)}
    cells |= {name: percent(rows[column].mean()) for column, name in _MIDDLES.items()}
    held = rows["modes_90"].dropna()
    cells["with modes"] = len(held)
    cells["in a mode's 90 %"] = _share(held)
    cells["best grasp said to work"] = percent(rows["grasp_chance"].mean())
    return cells | {"works": _share(rows["grasp_works"])}


def _stops_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Return a row for every policy and spread at which it would stop."""
    lines: list[dict[str, Any]] = []
    for spread in _STOP_SPREADS:
        stops = statistics.first_stops(sessions.rows, spread)
        groups = {policy: stops[stops["policy"] == policy] for policy in sessions.policies}
        for name, some in {**groups, _ALL: stops}.items():
            if some.empty:
                continue
            lines.append(
                {
                    "policy": _ALL if name == _ALL else styles[name].title,
                    "stop at spread of": f"{_MM * spread:g} mm",
                    "sessions": sessions.count * (len(groups) if name == _ALL else 1),
                    "stopped": len(some),
                    "probes, median": float(some["probes"].median()),
                    "error at most": f"{_MM * _STOP_FACTOR * spread:g} mm",
                    "share [95 %]": _share(some["error"] <= _STOP_FACTOR * spread),
                    "largest error": f"{_MM * some['error'].max():.1f} mm",
                }
            )
    return table_of("Stopping by the spread of the belief", lines, labels=2)


def _decision_times(rows: pd.DataFrame, styles: Styles) -> Table:
    rows = rows.assign(decision=rows["decision_seconds"], registration=rows["seconds"])
    rows["both"] = rows["registration"] + rows["decision"].fillna(0.0)
    groups = rows.groupby("policy")[["decision", "registration", "both"]]
    found = {"median": _MM * groups.quantile(0.5), "p95": _MM * groups.quantile(0.95)}
    lines = []
    for policy, style in styles.items():
        line: dict[str, Any] = {"policy": style.title}
        for name in ("decision", "registration", "both"):
            line |= {f"{name}, {kind}": of.loc[policy, name] for kind, of in found.items()}
        lines.append(line)
    return table_of("Milliseconds a probe, medians and 95th percentiles", lines)
