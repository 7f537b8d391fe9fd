"""Plausible diversity (PD): over the probes, and as box plots; a panel for every object."""

from __future__ import annotations

from collections.abc import Callable

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from runners.reporting.figures import (
    Picture,
    draw_quartiles,
    legend_of_methods,
    panels,
    positive_scale,
)
from runners.reporting.section import LAST_HALF, Section, Styles, Subject
from runners.reporting.statistics import DIVERSITY, spreads
from runners.reporting.tables import method_table

_COLUMNS = 3  # of panels


def over_probes(subject: Subject) -> Section | None:
    """PD at every step, by object; None without any."""
    rows, styles = subject.evaluation.rows, subject.styles
    if rows[DIVERSITY].isna().all():
        return None
    picture = picture_over_probes(rows, styles, "pd_over_probes")
    text = (
        "Median (line) and 25th to 75th percentile (band) over the trials of an object, all of "
        "its configurations and seeds, at every step. Lower is better. Configurations have more "
        "or fewer probes, so that first and last steps are of some trials only."
    )
    tables = (
        method_table(f"PD in mm² of {name} by step", some, "step", styles)
        for name, some in rows[rows["step"].notna()].groupby("object")
    )
    title = "Plausible diversity over the probes"
    return Section("over-probes", title, text, picture, tables=tuple(tables))


def boxes(subject: Subject) -> Section | None:
    """PD of the last half of all trials; None without any."""
    half, styles = subject.evaluation.last_half, subject.styles
    if half[DIVERSITY].isna().all():
        return None
    picture = picture_of_boxes(half, styles, "pd_boxes")
    text = (
        f"{LAST_HALF} Boxes span the 25th to the 75th percentile, white lines are medians; "
        "whiskers reach the least and greatest numbers apart from outliers, which are diamonds "
        "(farther than 1.5 boxes from the box). Lower is better."
    )
    tables = (
        method_table(f"PD in mm² by {by}", half, by, styles) for by in ("object", "configuration")
    )
    title = "Plausible diversity by object and method"
    return Section("boxes", title, text, picture, tables=tuple(tables))


def of_medial_constraint(subject: Subject) -> Section | None:
    """The Medial Constraint with and without quality diversity."""
    return _of_methods(
        subject,
        ("chsel", "medial_constraint", "medial_constraint_cma_me"),
        "medial",
        "The Medial Constraint with and without quality diversity",
        "What quality-diversity search brings to the objective of the Medial Constraint, beside "
        "CHSEL.",
    )


def of_cvo(subject: Subject) -> Section | None:
    """CVO with and without free space."""
    return _of_methods(
        subject,
        ("icp", "cvo", "cvo_no_free_space"),
        "cvo",
        "CVO with and without free space",
        "What CVO gains or loses by free points, beside ICP, which never uses them.",
    )


def _of_methods(
    subject: Subject, methods: tuple[str, ...], name: str, title: str, text: str
) -> Section | None:
    """PD over the probes of a few methods; None unless two of them have it."""
    styles, evaluation = subject.styles_of(methods), subject.evaluation
    with_diversity = evaluation.rows.dropna(subset=DIVERSITY)["method"]
    if with_diversity[with_diversity.isin(list(styles))].nunique() < 2:
        return None
    text += " Median and 25th to 75th percentile over the trials of an object at every step."
    picture = picture_over_probes(evaluation.rows, styles, name)
    rows = evaluation.last_half
    rows = rows[rows["method"].isin(list(styles))]
    heading = "PD in mm² by object, of these methods"
    table = method_table(heading, rows, "object", styles, note=LAST_HALF)
    return Section(name, title, text, picture, tables=(table,))


def picture_over_probes(rows: pd.DataFrame, styles: Styles, name: str) -> Picture:
    """A line and a band for every method; some step of theirs has a PD."""
    rows = _with_diversity(rows, styles)
    found = spreads(rows, ["object", "method", "step"], DIVERSITY)
    figure, axes = _object_panels(
        rows, lambda panel, name: _draw_lines(panel, found.loc[name], styles)
    )
    for panel in axes[-_COLUMNS:]:
        panel.set_xlabel("step (index of the probe)")
    shown = set(rows["method"])
    legend_of_methods(figure, [style for method, style in styles.items() if method in shown])
    alt = (
        f"Plausible diversity over probes for {', '.join(rows['object'].unique())}: a line of "
        "medians with its quartile band for each of "
        f"{', '.join(style.title for style in styles.values())}."
    )
    columns = ["count", "lower", "median", "upper"]
    return Picture(name, alt, figure, found[columns].reset_index())


def picture_of_boxes(rows: pd.DataFrame, styles: Styles, name: str) -> Picture:
    """A box for every method; some step of theirs has a PD."""
    rows = _with_diversity(rows, styles)
    by_object = dict(list(rows.groupby("object")))
    figure, axes = _object_panels(
        rows, lambda panel, name: _draw_boxes(panel, by_object[name], styles)
    )
    for index, panel in enumerate(axes):
        lowest = index + _COLUMNS >= len(axes)
        names = [style.title for style in styles.values()] if lowest else []
        panel.set_xticks(range(len(styles)), names, rotation=40, ha="right", fontsize=10)
    alt = (
        f"Box plots of plausible diversity for {', '.join(by_object)}, a box for each of "
        f"{', '.join(style.title for style in styles.values())}."
    )
    keys = ["object", "configuration", "seed", "method", "step", "draw"]
    return Picture(name, alt, figure, rows[[*keys, DIVERSITY]])


def _with_diversity(rows: pd.DataFrame, styles: Styles) -> pd.DataFrame:
    return rows[rows["method"].isin(list(styles)) & rows[DIVERSITY].notna()]


def _object_panels(
    rows: pd.DataFrame, draw: Callable[[Axes, str], None]
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for every object."""
    objects = sorted(rows["object"].unique())
    figure, axes = panels(len(objects), columns=_COLUMNS)
    for place, (panel, name) in enumerate(zip(axes, objects, strict=True)):
        draw(panel, name)
        panel.set_title(name.replace("_", " "))
        if place % _COLUMNS == 0:
            panel.set_ylabel("PD in mm²")
    return figure, axes


def _draw_lines(axes: Axes, found: pd.DataFrame, styles: Styles) -> None:
    """One object. found: `spreads` by method and step."""
    steps = sorted(found.index.unique("step"))
    for place, (method, style) in enumerate(styles.items()):
        if method not in found.index:
            continue
        of_method = found.loc[method]
        every_third = len(of_method) == len(steps) > 8
        draw_quartiles(
            axes,
            of_method.reindex(steps),  # a gap where a method has no number but others have
            style,
            alpha=0.13,
            markevery=(place % 3, 3) if every_third else None,
            zorder=3.0 - 0.01 * place,
        )
    positive_scale(axes, pd.concat([found["lower"], found["upper"]]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))


def _draw_boxes(axes: Axes, rows: pd.DataFrame, styles: Styles) -> None:
    """One object: matplotlib's boxes, with whiskers to the last number within 1.5 boxes."""
    for place, (method, style) in enumerate(styles.items()):
        values = rows.loc[rows["method"] == method, DIVERSITY]
        if values.empty:
            continue
        # All that is seen of a box without height is its median.
        flat = values.quantile(0.25) == values.quantile(0.75)
        axes.boxplot(
            values,
            positions=[place],
            widths=0.7,
            whis=1.5,
            patch_artist=True,
            boxprops={"facecolor": style.color, "edgecolor": "#222222", "linewidth": 0.8},
            medianprops={"color": style.color if flat else "#ffffff", "linewidth": 2.0},
            whiskerprops={"color": "#222222", "linewidth": 0.9},
            capprops={"color": "#222222", "linewidth": 0.9},
            flierprops={
                "marker": "D",
                "markersize": 3.0,
                "markerfacecolor": style.color,
                "markeredgecolor": "none",
            },
        )
    positive_scale(axes, rows[DIVERSITY])
    axes.set_xlim(-0.6, len(styles) - 0.4)
    axes.grid(axis="x", visible=False)
