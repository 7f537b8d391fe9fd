"""Error of the set and spread of the belief over the number of probes, by policy."""

from __future__ import annotations

import numpy as np
import pandas as pd

from runners.reporting.figures import (
    NotDrawn,
    Picture,
    draw_quartiles,
    legend_of_methods,
    panels,
    positive_scale,
)
from runners.reporting.section import Section, Styles, drawn
from runners.reporting.steered_sessions import (
    LEAST_ERROR,
    SteeredSessions,
    bootstrap_interval,
    geometric_means,
)
from runners.reporting.tables import Cell, Table, number

_MM = 1000.0
_COLUMNS = {"error": "error of the set, mm", "spread": "spread of the belief, mm"}


def error_over_probes(sessions: SteeredSessions, styles: Styles) -> Section:
    """A panel for each of the two, a table of errors, and one of ratios."""
    picture, missing = drawn(lambda: picture_over_probes(sessions, styles))
    text = (
        "Error: how far the object's surface in a hypothesis is from that in the true pose, root "
        "mean square over points of both surfaces, on average over the set; before the first "
        "contact, of the poses that the free space allows. Spread: the same between two poses of "
        f"the belief. Geometric means over {sessions.count} sessions, which all policies have; "
        f"errors below {_MM * LEAST_ERROR:g} mm count as {_MM * LEAST_ERROR:g} mm. Bands are 95 % "
        "intervals of these means, by a bootstrap over configurations."
    )
    tables = (error_table(sessions, styles), spread_table(sessions, styles), *_ratios(sessions))
    title = "Error and spread over probes"
    return Section("error-over-probes", title, text, picture, missing, tables)


def error_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Geometric means of the errors after so many probes, mm."""
    return _means_table(sessions, styles, "error", "Error of the set after so many probes, mm")


def spread_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Geometric means of the belief's spread after so many probes, mm."""
    return _means_table(sessions, styles, "spread", "Spread of the belief, mm")


def _means_table(sessions: SteeredSessions, styles: Styles, column: str, title: str) -> Table:
    means = _MM * geometric_means(sessions.over_probes(column))
    shown = [n for n in means.columns if n <= 2 or n % 2 == 0 or n == sessions.budget]
    best = means.min()
    rows = [
        (
            Cell(styles[policy].title),
            *(_best_cell(means.loc[policy, n], best[n], len(means)) for n in shown),
        )
        for policy in sessions.policies
        if policy in means.index
    ]
    note = f"Geometric means over {sessions.count} sessions."
    return Table(title, ("policy", *map(str, shown)), tuple(rows), note=note)


def _best_cell(value: float, best: float, count: int) -> Cell:
    return Cell(number(value), best=bool(value == best) and count > 1)


def ratios_to_best(sessions: SteeredSessions) -> pd.Series:
    """Error of the reference by that of the best other policy, by number of probes."""
    means = geometric_means(sessions.errors)
    others = means.drop(index=sessions.reference)
    return means.loc[sessions.reference] / others.min()


def _ratios(sessions: SteeredSessions) -> list[Table]:
    if len(sessions.policies) < 2 or not sessions.count:
        return []
    ratios = ratios_to_best(sessions).dropna()
    title = f"Error of {sessions.reference} by that of the best other policy"
    header = ("", *map(str, ratios.index), "largest")
    row = (Cell("ratio"), *(Cell(f"{ratio:.2f}") for ratio in [*ratios, ratios.max()]))
    note = "Ratios of geometric means after so many probes; below 1 is better than all others."
    return [Table(title, header, (row,), note=note)]


def picture_over_probes(sessions: SteeredSessions, styles: Styles) -> Picture:
    """Geometric means with bands; NotDrawn without a session."""
    if not sessions.count:
        raise NotDrawn("no session is finished by all policies")
    figure, axes = panels(2, columns=2, row_height=4.2)
    data = []
    for panel, (column, label) in zip(axes, _COLUMNS.items(), strict=True):
        values = _MM * sessions.over_probes(column)
        means = geometric_means(values / _MM) * _MM
        for policy in sessions.policies:
            logs = np.log(values.loc[policy].clip(lower=_MM * LEAST_ERROR))
            bands = [np.exp(bootstrap_interval(logs[probes])) for probes in logs]
            found = pd.DataFrame(bands, index=logs.columns, columns=["lower", "upper"])
            found["median"] = means.loc[policy]  # what the line shows
            draw_quartiles(panel, found, styles[policy], alpha=0.08)
            found = found.rename(columns={"median": "geometric_mean"}).rename_axis("probes")
            data.append(found.reset_index().assign(number=column, policy=policy))
        every = pd.concat(data)
        every = every[every["number"] == column]
        positive_scale(panel, every["geometric_mean"].replace(0.0, np.nan).dropna())
        panel.set_xlim(1.0, max(sessions.budget, 2))
        panel.set_ylabel(label)
        panel.set_xlabel("probes")
    legend_of_methods(figure, [styles[policy] for policy in sessions.policies])
    titles = ", ".join(styles[policy].title for policy in sessions.policies)
    alt = f"Error of the set and spread of the belief over the number of probes of {titles}."
    return Picture("error_over_probes", alt, figure, pd.concat(data))
