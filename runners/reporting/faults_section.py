"""The section of a report on faults: whether sets hold the truth, drawn by level and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from runners.reporting.by_faults import (
    Levels,
    Styles,
    rows_by_level,
    shares_held,
    tables_by_faults,
    with_all,
)
from runners.reporting.evaluation_folder import Evaluation
from runners.reporting.panels import drawn, legend_of_methods, new_figure
from runners.reporting.section import Picture, Section
from runners.reporting.statistics import share_interval


def sections_on_faults(evaluation: Evaluation, styles: Styles) -> list[Section]:
    """The section; none if no session had faults and no method has a set that holds poses."""
    tables = tables_by_faults(evaluation.rows, styles)
    if not tables:
        return []
    text = (
        "Sessions with faults have the probes of those without, see docs/faults.md; plausible sets "
        "are of the contacts without faults. All other sections pool the levels. Distances of "
        "hypotheses are root mean square distances between surfaces, so modulo symmetries."
    )
    picture = _picture(rows_by_level(evaluation.rows), styles)
    title = "Faults, and whether sets hold the truth"
    return [Section("faults", title, text, picture, tables=tables)]


def _picture(levels: Levels, styles: Styles) -> Picture | None:
    """Shares with their intervals; None where no method tells whether its set holds the truth."""
    shares = {method: shares_held(levels, method) for method in styles}
    told = {method: found for method, found in shares.items() if found}
    if not told:
        return None
    texts = [
        f"{styles[method].title} {100.0 * held / count:.0f} % ({level})"
        for method, found in told.items()
        for level, (held, count) in found.items()
    ]
    alt = f"Share of steps with the true pose in the set, by faults: {', '.join(texts)}."
    return Picture(
        "truth_held.png", alt, drawn(lambda: _figure(list(with_all(levels)), told, styles))
    )


def _figure(
    levels: Sequence[str], told: Mapping[str, Mapping[str, tuple[int, int]]], styles: Styles
) -> Figure:
    figure = new_figure(1.4 + 0.34 * len(levels))
    axes = figure.add_subplot()
    axes.axvline(95.0, color="#222222", linewidth=1.0, linestyle=":")
    for index, (method, found) in enumerate(told.items()):
        apart = 0.5 * (index - 0.5 * (len(told) - 1)) / len(told)
        for place, level in enumerate(levels):
            if level not in found:
                continue
            low, high = share_interval(*found[level])
            share = found[level][0] / found[level][1]
            axes.errorbar(
                100.0 * share,
                place + apart,
                xerr=100.0 * np.array([[share - low], [high - share]]),
                color=styles[method].color,
                marker=styles[method].marker,
                capsize=3.0,
            )
    axes.set_yticks(range(len(levels)), levels)
    axes.set_ylim(len(levels) - 0.5, -0.5)
    axes.set_xlim(-2.0, 102.0)
    axes.set_xlabel("steps with the true pose in the set, %, with 95 % intervals; dotted: 95 %")
    axes.grid(axis="y", visible=False)
    legend_of_methods(figure, [styles[method] for method in told])
    return figure
