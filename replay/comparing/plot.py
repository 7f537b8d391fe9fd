"""The picture of a comparison: every number over the steps, a line for each method."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from chsel.errors import SettingError
from replay.comparing.comparison import Column
from replay.files import new_file

SUFFIXES = (".png", ".svg", ".pdf")
_MARKERS = "os^DvPX"


def require_picture(path: Path) -> None:
    """Raise SettingError unless a picture can be written under this name."""
    if path.suffix.lower() not in SUFFIXES:
        raise SettingError(
            f"{path} is not the name of a picture; accepted: *{', *'.join(SUFFIXES)}"
        )


def write_plot(path: Path, rows: pd.DataFrame, columns: list[Column], title: str) -> None:
    """Write a new picture, PNG, SVG or PDF by its suffix, with a panel for every column.

    rows: as `frame` makes them. What failed, and costs that are infinite, are gaps.
    """
    require_picture(path)
    height = math.ceil(len(columns) / 4)
    figure = Figure(figsize=(13, 1.1 + 3.0 * height), layout="constrained")
    for place, column in enumerate(columns):
        axes = figure.add_subplot(height, min(4, len(columns)), place + 1)
        values = rows.pivot(index="step", columns="label", values=column.csv_name) * column.times
        values = values[rows["label"].unique()]
        for number, label in enumerate(values):
            line = ":" if number == 0 else "-"  # the recorded one
            axes.plot(values[label], line, marker=_MARKERS[number % 7], alpha=0.8, label=label)
        axes.set_title(column.title, fontsize=10)
        axes.set_xlabel("step")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        positive = values.min().min() > 0.0
        axes.set_yscale("log" if positive and "cost" in column.title else "linear")
        axes.grid(color="#dddddd", linewidth=0.6)
    if columns:
        lines, labels = axes.get_legend_handles_labels()
        figure.legend(lines, labels, loc="outside lower center", ncols=min(len(labels), 5))
    figure.suptitle(title, fontsize=11, parse_math=False)
    with new_file(path) as beside:
        figure.savefig(beside, format=path.suffix.lower()[1:], dpi=120)
