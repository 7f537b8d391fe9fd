"""PD and cost over the iterations of quality-diversity search."""

from __future__ import annotations

import pandas as pd

from runners.reporting.figures import (
    NotDrawn,
    Picture,
    draw_quartiles,
    legend_of_methods,
    panels,
    positive_scale,
)
from runners.reporting.section import Section, Styles, Subject, drawn
from runners.reporting.statistics import DIVERSITY, spreads
from runners.reporting.tables import Table, method_table

_COLUMNS = {  # label of the axis, title of the table
    DIVERSITY: ("PD in mm²", "PD in mm² by iteration"),
    "mean_cost": ("mean relaxed cost of the best cells", "Mean cost by iteration"),
}
_NO_RELAXED_COST = "medial_constraint"  # methods that begin so search by another cost, in m^2


def over_iterations(subject: Subject) -> Section | None:
    """Medians and quartiles over trials and steps; None where no moment was measured."""
    moments = subject.evaluation.iterations
    if moments.empty:
        return None
    styles = subject.styles_of(moments["method"].unique())
    picture, missing = drawn(lambda: picture_over_iterations(moments, styles))
    text = (
        "What a method would give if its search ended after so many iterations: PD of the "
        "hypotheses, and the mean cost of the best cells, from which these are taken. Medians and "
        "25th to 75th percentiles over trials and steps; all searches of a trial and step start "
        "alike."
    )
    if configurations := sorted(moments["configuration"].unique()):
        text += f" Of {', '.join(configurations)}."
    title = "Plausible diversity and cost over QD iterations"
    tables = tables_over_iterations(moments, styles)
    return Section("over-iterations", title, text, picture, missing, tables)


def tables_over_iterations(moments: pd.DataFrame, styles: Styles) -> tuple[Table, ...]:
    """Of both numbers."""
    tables = []
    for column, (_, title) in _COLUMNS.items():
        rows = _comparable(moments, column)
        if rows[column].notna().any():
            shown = {m: style for m, style in styles.items() if (rows["method"] == m).any()}
            tables.append(method_table(title, rows, "iteration", shown, column=column))
    return tuple(tables)


def _comparable(moments: pd.DataFrame, column: str) -> pd.DataFrame:
    """Without the costs that are of another kind."""
    if column != "mean_cost":
        return moments
    return moments[~moments["method"].str.startswith(_NO_RELAXED_COST)]


def picture_over_iterations(moments: pd.DataFrame, styles: Styles) -> Picture:
    """A panel for both numbers; NotDrawn where there is none."""
    if moments[list(_COLUMNS)].isna().all(axis=None):
        raise NotDrawn("no moment within a registration has a number")
    figure, axes = panels(2, columns=2, row_height=3.8)
    data = []
    for panel, (column, (label, _)) in zip(axes, _COLUMNS.items(), strict=True):
        rows = _comparable(moments, column)
        found = spreads(rows, ["method", "iteration"], column).query("count > 0")
        for place, (method, style) in enumerate(styles.items()):
            if method in found.index:
                of_method = found.loc[method]
                every = max(1, len(of_method) // 12)
                markers = (place % every, every)
                draw_quartiles(panel, of_method, style, alpha=0.18, markevery=markers)
        positive_scale(panel, pd.concat([found["lower"], found["upper"]]))
        last = rows["iteration"].max() if len(rows) else 1
        panel.set_xlim(0.0, last or 1)
        panel.set_ylabel(label)
        panel.set_xlabel("QD iterations")
        found = found[["count", "lower", "median", "upper"]].reset_index()
        data.append(found.assign(number=column))
    legend_of_methods(figure, list(styles.values()))
    alt = (
        "Plausible diversity and mean cost of the best cells over iterations of "
        f"{' and '.join(style.title for style in styles.values())}: medians with quartile bands."
    )
    return Picture("over_iterations", alt, figure, pd.concat(data))
