"""The picture of a benchmark: times by problem, what they are good for, and how they grow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from runners.benchmarks.benchmark_tables import number
from runners.benchmarks.pd_over_time import PD
from runners.reporting.figures import Picture, new_figure, positive_scale

Values = Mapping[str, Any]

_PACKAGE = "package"
_COLORS = {
    "ours, reference": "#0b3c5d",
    "ours, paper": "#1b6ca8",
    "ours, default": "#7db8e0",
    "anchored, small": "#a8d5a2",
    "anchored, medium": "#5fae57",
    "anchored, adaptive": "#2f7a34",
    "package": "#d1603d",
    "package, Eq. 8": "#8c3a22",
}
_PRESETS = ("reference", "paper", "default")
_GROWTH = {
    "free, more space": "free points, in a larger box",
    "free, denser": "free points, in the same box",
    "hypotheses": "hypotheses B",
}


def picture_of_benchmark(report: Values) -> Picture | None:
    """Bars of times by problem, PD over time, lines over sizes; None if none was measured."""
    compared, alone = pd.DataFrame(report["comparison"]), pd.DataFrame(report["alone"])
    growth = {}
    if len(alone):
        growth = {name: alone[alone["measure"] == name] for name in _GROWTH}
        growth = {name: rows for name, rows in growth.items() if len(rows)}
    curves = alone[alone["measure"] == PD] if len(alone) else alone
    parts = bool(len(compared)) + bool(len(curves)) + bool(growth)
    if not parts:
        return None
    figure = new_figure(1.0 + 4.2 * parts)
    grid = figure.add_gridspec(parts, max(1, len(growth)))
    if len(compared):
        _draw_times(figure.add_subplot(grid[0, :]), compared)
    if len(curves):
        _draw_curves(figure.add_subplot(grid[int(bool(len(compared))), :]), curves)
    for column, (name, rows) in enumerate(growth.items()):
        _draw_growth(figure.add_subplot(grid[parts - 1, column]), rows, _GROWTH[name])
    machine = report["machine"]
    figure.suptitle(
        f"One registration, one thread: {machine['processor']}, Python {machine['python']}, "
        f"torch {machine['package torch']}, load {machine['load_before']} before and "
        f"{machine['load_after']} after",
        fontsize=10,
    )
    data = pd.concat([compared, curves, *growth.values()])
    columns = ["case", "who", "measure", "at", "median", "lower_quartile", "upper_quartile"]
    alt = "Milliseconds of a registration by problem, PD over them, and how they grow."
    return Picture("benchmark", alt, figure, data.reindex(columns=columns))


def _draw_times(axes: Axes, rows: pd.DataFrame) -> None:
    """Bars of medians with their quartiles; over ours, how many times faster than the package."""
    problems = list(rows["case"].unique())
    names = [who for who in _COLORS if (rows["who"] == who).any()]
    width = 0.8 / len(names)
    for place, who in enumerate(names):
        own = rows[rows["who"] == who]
        x = own["case"].map(problems.index).to_numpy() + (place - (len(names) - 1) / 2) * width
        quartiles = own[["lower_quartile", "upper_quartile"]].to_numpy()
        spread = np.abs(quartiles - own[["median"]].to_numpy()).T
        axes.bar(
            x, own["median"], width, color=_COLORS[who], yerr=spread, ecolor="#333333", label=who
        )
        for at, row in zip(x, own.itertuples(), strict=True):
            text = number(row.median)
            if row.faster:
                text += f"\n{number(row.faster[_PACKAGE])}x"
            axes.annotate(
                text,
                (at, row.upper_quartile),
                (0, 3),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7,
            )
    positive_scale(axes, rows["median"])
    lower, upper = axes.get_ylim()
    axes.set_ylim(lower, 2.0 * upper)  # room for what stands over the bars
    axes.set_xticks(range(len(problems)), problems)
    axes.set_ylabel("ms, median and quartiles")
    axes.set_xlabel(
        "problem: size of the drill, contacts; x: how many times as long the package takes"
    )
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=len(names), fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_curves(axes: Axes, rows: pd.DataFrame) -> None:
    """PD over the time of a registration, a line for each method; each dot is an effort."""
    for index, (who, own) in enumerate(rows.groupby("who", sort=False)):
        own = own.sort_values("at")
        axes.plot(own["at"], own["median"], "o-", color=f"C{index}", label=who)
    positive_scale(axes, rows["at"], axis="x")
    positive_scale(axes, rows["median"])
    axes.set_xlabel("ms of a registration, median")
    axes.set_ylabel("PD in mm², geometric mean")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _draw_growth(axes: Axes, rows: pd.DataFrame, label: str) -> None:
    for preset in _PRESETS:
        own, color = rows[rows["who"] == preset], _COLORS[f"ours, {preset}"]
        axes.plot(own["at"], own["median"], "o-", color=color, label=preset)
        quartiles = own["lower_quartile"], own["upper_quartile"]
        axes.fill_between(own["at"], *quartiles, color=color, alpha=0.2, linewidth=0)
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel(label)
    axes.set_ylabel("ms")
    axes.legend(fontsize=8, loc="upper left")
