"""The picture of a benchmark: times by problem, and how they grow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from runners.benchmarks.benchmark_tables import number
from runners.reporting.figures import Picture, new_figure, positive_scale

Values = Mapping[str, Any]

_COLORS = {
    "ours, reference": "#0b3c5d",
    "ours, paper": "#1b6ca8",
    "ours, default": "#7db8e0",
    "package": "#d1603d",
    "package, Eq. 8": "#8c3a22",
}
_PRESETS = ("reference", "paper", "default")
_LIKE = {"package": "reference", "package, Eq. 8": "paper"}  # whose cost is of the same form
_GROWTH = {
    "free, more space": "free points, in a larger box",
    "free, denser": "free points, in the same box",
    "hypotheses": "hypotheses B",
}


def picture_of_benchmark(report: Values) -> Picture | None:
    """Bars of times by problem, and lines over sizes; None if neither was measured."""
    compared, alone = pd.DataFrame(report["comparison"]), pd.DataFrame(report["alone"])
    growth = {}
    if len(alone):
        growth = {name: alone[alone["measure"] == name] for name in _GROWTH}
        growth = {name: rows for name, rows in growth.items() if len(rows)}
    parts = bool(len(compared)) + bool(growth)
    if not parts:
        return None
    figure = new_figure(1.0 + 4.2 * parts)
    grid = figure.add_gridspec(parts, max(1, len(growth)))
    if len(compared):
        _draw_times(figure.add_subplot(grid[0, :]), compared)
    for column, (name, rows) in enumerate(growth.items()):
        _draw_growth(figure.add_subplot(grid[parts - 1, column]), rows, _GROWTH[name])
    machine = report["machine"]
    figure.suptitle(
        f"One registration, one thread: {machine['processor']}, Python {machine['python']}, "
        f"torch {machine['package torch']}, load {machine['load_before']} before and "
        f"{machine['load_after']} after",
        fontsize=10,
    )
    data = pd.concat([compared, *growth.values()])
    columns = ["case", "who", "measure", "at", "median", "lower_quartile", "upper_quartile"]
    alt = "Milliseconds of a registration by problem, and how they grow."
    return Picture("benchmark", alt, figure, data.reindex(columns=columns))


def _draw_times(axes: Axes, rows: pd.DataFrame) -> None:
    """Bars of medians with their quartiles; over those of the package, times ours."""
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
            if row.times_ours:
                text += f"\n{number(row.times_ours[_LIKE[who]])}x"
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
        "problem: size of the drill, contacts; x: times as long as ours with the same form of cost"
    )
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=len(names), fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))


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
