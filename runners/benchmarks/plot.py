"""The picture of a benchmark: times by problem, and how they grow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from replay.files import whole_file
from runners.benchmarks.report import number
from runners.run.recording import IN_RUN_FOLDER

Values = Mapping[str, Any]

_COLORS = {
    "ours, reference": "#0b3c5d",
    "ours, paper": "#1b6ca8",
    "ours, default": "#7db8e0",
    "package": "#d1603d",
    "package, Eq. 8": "#8c3a22",
}
_PRESET_COLORS = {"reference": "#0b3c5d", "paper": "#1b6ca8", "default": "#7db8e0"}
_LIKE = {"package": "reference", "package, Eq. 8": "paper"}  # whose cost is of the same form
_GROWTH = (
    ("free, more space", "free points, in a larger box"),
    ("free, denser", "free points, in the same box"),
    ("hypotheses", "hypotheses B"),
)


def draw(report: Values, path: Path) -> None:
    """Write the picture as PNG; parts that were not measured are left out."""
    growth = [(m, x) for m, x in _GROWTH if any(r["measure"] == m for r in report["alone"])]
    rows = bool(report["comparison"]) + bool(growth)
    if not rows:
        return
    figure = Figure(figsize=(12, 1.0 + 4.2 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(rows, max(1, len(growth)))
    if report["comparison"]:
        _draw_times(figure.add_subplot(grid[0, :]), report["comparison"])
    for column, (measure, label) in enumerate(growth):
        axes = figure.add_subplot(grid[rows - 1, column])
        _draw_growth(axes, [r for r in report["alone"] if r["measure"] == measure], label)
    figure.suptitle(_title(report["machine"]), fontsize=10)
    with whole_file(path, IN_RUN_FOLDER) as beside:
        figure.savefig(beside, format="png", dpi=120)


def _title(machine: Values) -> str:
    return (
        f"One registration, one thread: {machine['processor']}, Python {machine['python']}, "
        f"torch {machine['package torch']}, load {machine['load_before']} before and "
        f"{machine['load_after']} after"
    )


def _draw_times(axes: Axes, rows: Sequence[Values]) -> None:
    """Bars of medians with their quartiles; over those of the package, times ours."""
    problems = list(dict.fromkeys(row["case"] for row in rows))
    names = [who for who in _COLORS if any(row["who"] == who for row in rows)]
    width = 0.8 / len(names)
    for place, who in enumerate(names):
        for row in (row for row in rows if row["who"] == who):
            x = problems.index(row["case"]) + (place - (len(names) - 1) / 2) * width
            median = row["median"]
            spread = [[median - row["lower_quartile"]], [row["upper_quartile"] - median]]
            axes.bar(x, median, width, color=_COLORS[who], yerr=spread, ecolor="#333333")
            text = number(median)
            if row["times_ours"]:
                text += f"\n{number(row['times_ours'][_LIKE[who]])}x"
            axes.annotate(
                text,
                (x, row["upper_quartile"]),
                (0, 3),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7,
            )
        axes.bar(0, 0, color=_COLORS[who], label=who)
    axes.set_yscale("log")
    lower, upper = axes.get_ylim()
    axes.set_ylim(lower, 2.0 * upper)  # room for what stands over the bars
    axes.set_xticks(range(len(problems)), problems)
    axes.set_ylabel("ms, median and quartiles")
    axes.set_xlabel(
        "problem: size of the drill, contacts; x: times as long as ours with the same form of cost"
    )
    axes.legend(ncols=len(names), fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes.spines[["top", "right"]].set_visible(False)


def _draw_growth(axes: Axes, rows: Sequence[Values], label: str) -> None:
    for preset, color in _PRESET_COLORS.items():
        chosen = [row for row in rows if row["who"] == preset]
        at = [row["at"] for row in chosen]
        axes.plot(at, [row["median"] for row in chosen], "o-", color=color, label=preset)
        lower, upper = ([row[f"{side}_quartile"] for row in chosen] for side in ("lower", "upper"))
        axes.fill_between(at, lower, upper, color=color, alpha=0.2, linewidth=0)
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel(label)
    axes.set_ylabel("ms")
    axes.legend(fontsize=8, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
