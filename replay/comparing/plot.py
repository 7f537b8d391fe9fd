"""The picture of a comparison: every number over the steps, a line for each method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from chsel.errors import SettingError
from replay.comparing.columns import Column, columns_in_table
from replay.comparing.comparison import Outcome
from replay.files import new_file

SUFFIXES = (".png", ".svg", ".pdf")
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_RECORDED = "#555555"
_ROW, _COLUMN_COUNT = 3.0, 4  # inches, panels
_CLOCKLESS = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}, ".png": {}}


def require_picture(path: Path) -> None:
    """Raise SettingError unless a picture can be written under this name."""
    if path.suffix.lower() not in SUFFIXES:
        raise SettingError(
            f"{path} is not the name of a picture; accepted: *{', *'.join(SUFFIXES)}"
        )


def write_plot(path: Path, outcomes: Sequence[Outcome], title: str) -> None:
    """Write a new picture, PNG, SVG or PDF by its suffix, with a panel for every number.

    The first label is drawn as the recorded one. What failed, and costs that are infinite, are
    gaps.
    """
    require_picture(path)
    columns = columns_in_table({name for outcome in outcomes for name in outcome.numbers})
    labels = list(dict.fromkeys(outcome.label for outcome in outcomes))
    rows = max(1, math.ceil(len(columns) / _COLUMN_COUNT))
    figure = Figure(figsize=(13, 1.1 + _ROW * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for place, column in enumerate(columns):
        axes = figure.add_subplot(rows, min(_COLUMN_COUNT, len(columns)), place + 1)
        _draw(axes, column, outcomes, labels)
    if columns:
        handles, names = figure.axes[0].get_legend_handles_labels()
        legend = figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 5))
        for text in legend.get_texts():
            text.set_parse_math(False)
    figure.suptitle(title, fontsize=11, parse_math=False)
    suffix = path.suffix.lower()
    with (
        matplotlib.rc_context({"svg.hashsalt": "chsel"}),  # else its names differ each time
        new_file(path) as beside,
    ):
        figure.savefig(beside, format=suffix[1:], dpi=120, metadata=_CLOCKLESS[suffix])


def _draw(axes: Axes, column: Column, outcomes: Sequence[Outcome], labels: Sequence[str]) -> None:
    """One number over the steps."""
    drawn: list[float] = []
    for index, label in enumerate(labels):
        of_label = [outcome for outcome in outcomes if outcome.label == label]
        values = [_finite(column, outcome) for outcome in of_label]
        drawn += [value for value in values if not math.isnan(value)]
        style = _style(index, len(labels))
        axes.plot([outcome.step for outcome in of_label], values, label=label, **style)
    axes.set_title(column.title, fontsize=10)
    axes.set_xlabel("step")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    if column.log and drawn and max(drawn) > 0.0:
        _scale(axes, drawn)
    else:
        axes.set_ylim(bottom=0.0)
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _style(index: int, count: int) -> dict[str, Any]:
    """How a line is drawn; each is thinner than those below it, so that equal ones all show."""
    if index == 0:
        style: dict[str, Any] = {"color": _RECORDED, "linestyle": ":", "linewidth": 1.2}
        return style | {"marker": "o", "markersize": 10, "markerfacecolor": "none"}
    thickness = 1.0 - (index - 1) / max(count - 1, 1)
    color = _COLORS[(index - 1) % len(_COLORS)]
    style = {"color": color, "linewidth": 1.0 + 2.0 * thickness}
    return style | {
        "marker": _MARKERS[(index - 1) % len(_MARKERS)],
        "markersize": 3.0 + 4.0 * thickness,
    }


def _scale(axes: Axes, drawn: Sequence[float]) -> None:
    """A logarithmic scale, linear below the least number above zero if there are zeros."""
    if min(drawn) > 0.0:
        axes.set_yscale("log")
    else:
        axes.set_yscale("symlog", linthresh=min(value for value in drawn if value > 0.0))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if max(drawn) < 10.0 * min(drawn):  # few of the powers of ten are in view
        axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _finite(column: Column, outcome: Outcome) -> float:
    """The number in the unit shown, or NaN, which leaves a gap."""
    value = column.times * outcome.numbers.get(column.name, math.nan)
    return value if math.isfinite(value) else math.nan
