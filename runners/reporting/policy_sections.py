"""The sections of a report on policies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from runners.reporting.evaluation_folder import TRIAL, Evaluation, trials_of
from runners.reporting.figures import Picture, Styles, curves, policy_styles
from runners.reporting.page import Section
from runners.reporting.statistics import (
    GOOD,
    LEAST_ERROR,
    LIMITS,
    SteeredSessions,
    censored_quantile,
    first_below,
    first_stops,
    geometric_means,
    hit_bins,
    means_with_intervals,
    paired,
    ratios_to_best,
    shares,
    steered_sessions,
)
from runners.reporting.tables import Table, bold_best, number, percent_range, table_of, with_range

_STOP_SPREADS = (0.020, 0.010, 0.005)  # metres
_STOP_FACTOR = 1.5  # of the spread at which a session stops; an error above is a wrong stop
_ALL = "all"
_MM = 1000.0


def sections_on_policies(evaluation: Evaluation, reference: str | None = None) -> list[Section]:
    """What there is something to show of. Raises ReportError for a reference without a session."""
    sessions, styles = steered_sessions(evaluation, reference), policy_styles(evaluation.policies)
    sections = [_what_was_run(evaluation, sessions, styles)]
    if sessions.count:
        sections += [_error_over_probes(sessions, styles), _probes_needed(sessions, styles)]
        sections += _compared(sessions, styles)
        sections += [_forecasts(sessions, styles), _times(sessions, styles)]
    return sections


def _what_was_run(evaluation: Evaluation, sessions: SteeredSessions, styles: Styles) -> Section:
    probes, lines = evaluation.probes, []
    for policy, style in styles.items():
        own = probes[probes["policy"] == policy]
        failed, steps = own["status"].str.startswith("failed"), own["probes"].notna()
        done = trials_of(own[steps])
        lines.append(
            {
                "policy": style.title,
                "trials done": f"{len(done)} of {len({*evaluation.planned_trials} | done)}",
                "trials failed": len(trials_of(own[failed]) - done),
                "probes": int(steps.sum()),
                "registrations failed": int((failed & steps).sum()),
                "out of actions": int((own["stop"] == "actions").sum()),
            }
        )
    bad = probes[probes["status"].str.startswith("failed")]
    failures = [
        {"configuration": name, "policy": policy, "trials": len(trials_of(some)), "why": why}
        for (name, policy, why), some in bad.groupby(["configuration", "policy", "status"])
    ]
    left_out = f", {sessions.left_out} are left out" if sessions.left_out else ""
    text = (
        "A trial is a configuration with a seed, in which every policy has a session of its own. "
        f"All other sections are about the {sessions.count} trials that all policies have "
        f"finished{left_out}."
    )
    tables = [table_of("What is there", lines), table_of("What failed", failures, labels=2)]
    return Section("What was run", text, tables)


def _error_over_probes(sessions: SteeredSessions, styles: Styles) -> Section:
    text = (
        "Error: how far the object's surface in a hypothesis is from that in the true pose, root "
        "mean square over points of both surfaces, on average over the set; before the first "
        "contact, of the poses that the free space allows. Spread: the same between two poses of "
        f"the belief. Geometric means over {sessions.count} sessions, which all policies have; "
        f"errors below {_MM * LEAST_ERROR:g} mm count as {_MM * LEAST_ERROR:g} mm. Bands are 95 % "
        "intervals of these means, by a bootstrap over configurations."
    )
    tables = [error_table(sessions, styles)]
    tables.append(_means_table(sessions, styles, "spread", "Spread of the belief, mm"))
    if len(sessions.policies) > 1:
        ratios = ratios_to_best(sessions).dropna()
        cells = {str(probes): f"{ratio:.2f}" for probes, ratio in ratios.items()}
        line = {"": "ratio", **cells, "largest": f"{ratios.max():.2f}"}
        title = f"Error of {sessions.reference} by that of the best other policy"
        note = "Ratios of geometric means after so many probes; below 1 is better than all others."
        tables.append(table_of(title, [line], note=note))
    picture = picture_over_probes(sessions, styles)
    return Section("Error and spread over probes", text, tables, picture)


def error_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Geometric means of the errors after so many probes, mm."""
    return _means_table(sessions, styles, "error", "Error of the set after so many probes, mm")


def _means_table(sessions: SteeredSessions, styles: Styles, column: str, title: str) -> Table:
    means = _MM * geometric_means(sessions.over_probes(column)).loc[sessions.policies]
    shown = [n for n in means.columns if n <= 2 or n % 2 == 0 or n == sessions.budget]
    columns = {str(n): bold_best(means[n].tolist(), means[n].map(number).tolist()) for n in shown}
    lines = [
        {"policy": styles[policy].title, **{n: cells[index] for n, cells in columns.items()}}
        for index, policy in enumerate(means.index)
    ]
    return table_of(title, lines, note=f"Geometric means over {sessions.count} sessions.")


def picture_over_probes(sessions: SteeredSessions, styles: Styles) -> Picture:
    """Errors and spreads with their intervals, mm."""
    labels = {"error": "error of the set, mm", "spread": "spread of the belief, mm"}
    parts = [means_with_intervals(sessions, column).assign(number=column) for column in labels]
    data = pd.concat(parts, ignore_index=True)
    values = ["lower", "mean", "upper"]
    data[values] *= _MM
    titles = ", ".join(styles[policy].title for policy in sessions.policies)
    return curves(
        "error_over_probes",
        f"Error of the set and spread of the belief over the number of probes of {titles}.",
        data,
        styles,
        x="probes",
        y="mean",
        by="policy",
        panel="number",
        labels=("probes", labels),
    )


def _probes_needed(sessions: SteeredSessions, styles: Styles) -> Section:
    text = (
        "After how many probes the error of the set first is below a limit. A session that does "
        f"not get there within {sessions.budget} probes counts as needing more; the median is the "
        "least number by which half of the sessions are there (Kaplan-Meier). A session is "
        f"solvable if any policy gets below {_MM * GOOD:g} mm in it: here "
        f"{len(sessions.solvable)} of {sessions.count}."
    )
    return Section("Probes needed", text, [needed_table(sessions, styles)])


def needed_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Median [quartiles] of the probes to each limit, and shares of the sessions that get there."""
    lines = []
    for policy in sessions.policies:
        errors = sessions.errors.loc[policy]
        needed = first_below(errors, GOOD)
        solvable = needed[needed.index.isin(sessions.solvable)]
        line = {"policy": styles[policy].title}
        for limit in LIMITS:
            line[f"to {_MM * limit:g} mm"] = _quartiles(first_below(errors, limit), sessions.budget)
        line[f"below {_MM * GOOD:g} mm"] = _share_there(needed)
        line["of solvable"] = _share_there(solvable)
        line["to there, of solvable"] = _quartiles(solvable, sessions.budget)
        lines.append(line)
    note = (
        f"Medians [quartiles] of probes over {sessions.count} sessions, of which "
        f"{len(sessions.solvable)} are solvable; intervals of shares are of 95 % (Wilson)."
    )
    return table_of("Probes until the error of the set is below a limit", lines, note=note)


def _quartiles(needed: pd.Series, budget: int) -> str:
    if needed.empty:
        return "-"
    numbers = [censored_quantile(needed, share) for share in (0.25, 0.5, 0.75)]
    lower, median, upper = (f"{n:.0f}" if math.isfinite(n) else f">{budget}" for n in numbers)
    return f"{median} [{lower}, {upper}]"


def _share_there(needed: pd.Series) -> str:
    if needed.empty:
        return "-"
    flags = pd.DataFrame({_ALL: 0, "there": needed < math.inf})
    return percent_range(shares(flags, _ALL, "there").iloc[0])


def _compared(sessions: SteeredSessions, styles: Styles) -> Iterator[Section]:
    """Every policy beside the reference, session by session; and all of them by configuration."""
    if len(sessions.policies) < 2:
        return
    reference, lines = styles[sessions.reference].title, []
    for policy in sessions.policies:
        if policy == sessions.reference:
            continue
        of = paired(sessions, policy)
        counts = {"sessions": of.sessions, f"{reference} better": of.wins, "worse": of.losses}
        mean = with_range(of.mean, of.lower, of.upper)
        ratios = {"ratio, median": of.median, "ratio, geometric mean [95 %]": mean}
        test = {"sign test, p": f"{of.sign_test:.2g}"}
        lines.append({"policy": styles[policy].title, **counts, **test, **ratios})
    text = (
        f"Errors of the set after {sessions.compared} probes, session by session. A ratio is the "
        f"error of a policy by that of {reference} in the same configuration with the same seed; "
        "above 1 the latter is better."
    )
    note = (
        "The interval is a bootstrap over configurations, of which all seeds are drawn together; "
        "the sign test takes sessions as independent."
    )
    title = f"Error beside {reference} after {sessions.compared} probes"
    tables = [table_of(title, lines, note=note), _by_table(sessions, styles, "configuration")]
    if sessions.rows["faults"].nunique() > 1:
        tables.append(_by_table(sessions, styles, "faults"))
    yield Section("Policies compared, session by session", text, tables)


def _by_table(sessions: SteeredSessions, styles: Styles, by: str) -> Table:
    """Geometric means of the errors by what a column of the rows holds, mm."""
    lines = []
    for value, some in sessions.rows.groupby(by):
        trials = pd.MultiIndex.from_frame(some[TRIAL].drop_duplicates())
        own = sessions.errors[sessions.errors.index.droplevel("policy").isin(trials)]
        means = _MM * geometric_means(own).loc[sessions.policies, sessions.compared]
        cells = bold_best(means.tolist(), means.map(number).tolist())
        titles = [styles[policy].title for policy in means.index]
        line = {by: str(value), "n": len(trials)}
        lines.append(line | dict(zip(titles, cells, strict=True)))
    title = f"Error after {sessions.compared} probes by {by}, mm"
    return table_of(title, lines, note="Geometric means over n sessions of a policy.")


def _forecasts(sessions: SteeredSessions, styles: Styles) -> Section:
    """Whether forecasts come true: chances of a hit, and the spread at which a session stops."""
    rows = sessions.forecasts
    groups = {styles[policy].title: rows[rows["policy"] == policy] for policy in sessions.policies}
    groups["all, before the first contact"] = rows[~rows["touched"]]
    groups["all, after it"], groups[_ALL] = rows[rows["touched"]], rows
    hits = []
    for title, own in groups.items():
        if len(own):
            forecast, happened = 100.0 * own["hit_forecast"].mean(), 100.0 * own["hit"].mean()
            texts = {"forecast": f"{forecast:.1f}", "happened": f"{happened:.1f}"}
            texts["difference, points"] = f"{forecast - happened:+.1f}"
            hits.append({"policy": title, "probes": len(own), **texts})
    note = "Means over probes; a positive difference means that more was forecast than happened."
    bins = [
        {
            "forecast": f"{10 * tenth} to {10 * tenth + 10} %",
            "probes": int(of["total"]),
            "mean forecast": f"{100.0 * of['forecast']:.0f} %",
            "happened [95 %]": percent_range(of),
        }
        for tenth, of in hit_bins(rows).iterrows()
    ]
    tables = [
        table_of("Chance of a hit, forecast and happened, %", hits, note=note),
        table_of("Hits by their forecast, all policies", bins),
        stops_table(sessions, styles),
    ]
    text = (
        "Hits: the chance that was forecast for the chosen probe, and how often such probes met "
        "the object. Stops: where a session would have ended by the spread of its belief alone, at "
        "the first probe after which this is at most so much; it is a good stop if the error of "
        f"the set then is at most {_STOP_FACTOR:g} times as much."
    )
    return Section("Calibration of forecasts and of stopping", text, tables)


def stops_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """A row for every policy and spread at which it would stop."""
    lines: list[dict[str, Any]] = []
    for spread in _STOP_SPREADS:
        stops = first_stops(sessions.rows, spread)
        stops = stops.assign(good=stops["error"] <= _STOP_FACTOR * spread, all=_ALL)
        groups = {styles[p].title: stops[stops["policy"] == p] for p in sessions.policies}
        for title, some in {**groups, _ALL: stops}.items():
            if some.empty:
                continue
            lines.append(
                {
                    "policy": title,
                    "stop at spread of": f"{_MM * spread:g} mm",
                    "sessions": sessions.count * (len(sessions.policies) if title == _ALL else 1),
                    "stopped": len(some),
                    "probes, median": float(some["probes"].median()),
                    "error at most": f"{_MM * _STOP_FACTOR * spread:g} mm",
                    "share [95 %]": percent_range(shares(some, _ALL, "good").iloc[0]),
                    "largest error": f"{_MM * some['error'].max():.1f} mm",
                }
            )
    return table_of("Stopping by the spread of the belief", lines, labels=2)


def _times(sessions: SteeredSessions, styles: Styles) -> Section:
    rows = sessions.rows
    both = rows["seconds"] + rows["decision_seconds"].fillna(0.0)
    columns = {"decision": rows["decision_seconds"], "registration": rows["seconds"], "both": both}
    lines = []
    for policy in sessions.policies:
        line: dict[str, Any] = {"policy": styles[policy].title}
        for name, seconds in columns.items():
            ms = _MM * seconds[rows["policy"] == policy].dropna()
            for kind, share in (("median", 0.5), ("p95", 0.95)):
                line[f"{name}, {kind}"] = float(ms.quantile(share)) if len(ms) else np.nan
        lines.append(line)
    text = (
        "Wall-clock time on one thread, after a warm-up, of choosing the next probe, of the "
        "registration before it, and of both together. Several workers on one machine slow each "
        "other down."
    )
    table = table_of("Milliseconds a probe, medians and 95th percentiles", lines)
    return Section("Time per decision and registration", text, [table])
