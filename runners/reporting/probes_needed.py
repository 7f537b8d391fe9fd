"""How many probes it takes until the set is near the truth, and how often that happens."""

from __future__ import annotations

import math

import pandas as pd

from runners.reporting.figures import NotDrawn, Picture, legend_of_methods, new_figure
from runners.reporting.section import Section, Styles, drawn
from runners.reporting.statistics import shares
from runners.reporting.steered_sessions import (
    GOOD,
    LIMITS,
    SteeredSessions,
    censored_quantile,
    first_below,
)
from runners.reporting.tables import Cell, Table

_MM = 1000.0


def probes_needed(sessions: SteeredSessions, styles: Styles) -> Section:
    """A curve for each policy, and a table."""
    picture, missing = drawn(lambda: picture_of_found(sessions, styles))
    text = (
        "After how many probes the error of the set first is below a limit. A session that does "
        f"not get there within {sessions.budget} probes counts as needing more; the median is the "
        "least number by which half of the sessions are there (Kaplan-Meier). A session is "
        f"solvable if any policy gets below {_MM * GOOD:g} mm in it: here "
        f"{len(sessions.solvable)} of {sessions.count}."
    )
    table = needed_table(sessions, styles)
    return Section("probes-needed", "Probes needed", text, picture, missing, (table,))


def needed_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Median [quartiles] of the probes to each limit, and shares of the sessions that get there."""
    header = ["policy", *(f"to {_MM * limit:g} mm" for limit in LIMITS)]
    header += [f"below {_MM * GOOD:g} mm, %", "of solvable, %", "to there, of solvable"]
    rows = []
    for policy in sessions.policies:
        if not sessions.count:
            break
        errors = sessions.errors.loc[policy]
        cells = [_needed_cell(first_below(errors, limit), sessions.budget) for limit in LIMITS]
        needed = first_below(errors, GOOD)
        solvable = needed[needed.index.isin(sessions.solvable)]
        cells += [_share_cell(needed), _share_cell(solvable)]
        cells += [_needed_cell(solvable, sessions.budget)]
        rows.append((Cell(styles[policy].title), *cells))
    note = (
        f"Medians [quartiles] of probes over {sessions.count} sessions, of which "
        f"{len(sessions.solvable)} are solvable; intervals of shares are of 95 % (Wilson)."
    )
    title = "Probes until the error of the set is below a limit"
    return Table(title, tuple(header), tuple(rows), note=note)


def _needed_cell(needed: pd.Series, budget: int) -> Cell:
    lower, median, upper = (censored_quantile(needed, share) for share in (0.25, 0.5, 0.75))
    if math.isnan(median):
        return Cell("-")
    texts = [f"{n:.0f}" if math.isfinite(n) else f">{budget}" for n in (lower, median, upper)]
    return Cell(texts[1], between=f"[{texts[0]}, {texts[2]}]")


def _share_cell(needed: pd.Series) -> Cell:
    if needed.empty:
        return Cell("-")
    flags = pd.DataFrame({"all": 0, "there": needed < math.inf})
    of = shares(flags, "all", "there").iloc[0]
    interval = f"[{100.0 * of['lower']:.0f}, {100.0 * of['upper']:.0f}]"
    return Cell(f"{100.0 * of['share']:.0f}", between=interval)


def picture_of_found(sessions: SteeredSessions, styles: Styles) -> Picture:
    """Share of the sessions below GOOD by number of probes; NotDrawn without a session."""
    if not sessions.count:
        raise NotDrawn("no session is finished by all policies")
    figure = new_figure(4.4)
    axes = figure.add_subplot()
    at, texts = list(sessions.errors.columns), []
    data = {}
    for policy in sessions.policies:
        needed, style = first_below(sessions.errors.loc[policy], GOOD), styles[policy]
        percent = [100.0 * float((needed <= probes).mean()) for probes in at]
        axes.step(at, percent, where="post", color=style.color, linestyle=style.line)
        axes.plot(at, percent, color=style.color, marker=style.marker, linestyle="none")
        data[policy] = percent
        texts.append(f"{style.title} {percent[-1]:.0f} %")
    axes.axhline(
        100.0 * len(sessions.solvable) / sessions.count, color="#222222", linestyle=":", linewidth=1
    )
    axes.set_ylim(-2.0, 102.0)
    axes.set_xlim(1.0, max(sessions.budget, 2))
    axes.set_xlabel("probes; dotted: sessions that any policy solves")
    axes.set_ylabel(f"sessions below {_MM * GOOD:g} mm, %")
    legend_of_methods(figure, [styles[policy] for policy in sessions.policies])
    alt = f"Sessions below {_MM * GOOD:g} mm after {at[-1]} probes: {', '.join(texts)}."
    table = pd.DataFrame(data, index=pd.Index(at, name="probes")).reset_index()
    return Picture("probes_needed", alt, figure, table)
