"""Figures from data frames: lines with bands, boxes, and files that are the same everywhere."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from replay.files import whole_file

WIDTH = 12.0  # inches, of every figure
FORMATS = ("png", "svg", "pdf")
_DPI = 120
_NO_CLOCKS: dict[str, Any] = {  # metadata that is left out: when and with what a file was made
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.8,
    "lines.markersize": 5.0,
    "legend.frameon": False,
    "text.parse_math": False,  # names may hold a "$"
    "svg.hashsalt": "chsel",  # else the names of an SVG file's parts are random
}


@dataclass(frozen=True)
class Style:
    """The looks of a method or policy."""

    title: str
    color: str  # "#rrggbb"
    marker: str  # as matplotlib names it
    line: str  # likewise

    @property
    def looks(self) -> dict[str, Any]:
        """Arguments of matplotlib for a line."""
        return {"color": self.color, "marker": self.marker, "linestyle": self.line}


Styles = Mapping[str, Style]
# Colours after Okabe and Ito, and Tol: apart for colour-blind eyes. Variants of a method share a
# hue, a lighter one and broken lines for the second.
_KNOWN = {
    "chsel": Style("CHSEL", "#0072b2", marker="o", line="-"),
    "chsel_cma_me": Style("CHSEL (CMA-ME)", "#56b4e9", marker="s", line="--"),
    "gradient_descent": Style("Gradient descent", "#009e73", marker="^", line="-"),
    "svgd": Style("SVGD", "#e69f00", marker="D", line="-"),
    "icp": Style("ICP", "#6b6b6b", marker="P", line="-"),
    "cvo": Style("CVO", "#b2451c", marker="v", line="-"),
    "cvo_no_free_space": Style("CVO (no free space)", "#f08a5d", marker="<", line="--"),
    "medial_constraint": Style("Medial Constraint", "#882255", marker="X", line="-"),
    "medial_constraint_cma_me": Style("Medial Constraint (QD)", "#d889b8", marker="p", line="--"),
    # policies
    "grid": Style("grid", "#222222", marker="s", line="--"),
    "random": Style("random", "#999999", marker="d", line="--"),
    "nearest_mean": Style("nearest mean", "#56b4e9", marker="^", line="-"),
    "hit_chance": Style("hit chance", "#e69f00", marker="v", line="-"),
    "voxel_entropy": Style("voxel entropy", "#882255", marker="D", line="-"),
    "hypothesis_pruning": Style("hypothesis pruning", "#009e73", marker="X", line="-"),
    "information": Style("information", "#0072b2", marker="o", line="-"),
    "expected_loss": Style("expected loss", "#b2451c", marker="P", line="-"),
}
_OTHERS = ("#117733", "#332288", "#999933", "#999999", "#661100", "#44aa99")
_OTHER_MARKERS = ("h", "d", ">", "8", "*", "H")


def styles_of(names: Collection[str]) -> dict[str, Style]:
    """Return the looks of methods or policies in the order of all figures: ours, then by name."""
    styles = {name: style for name, style in _KNOWN.items() if name in names}
    for index, name in enumerate(sorted(set(names) - set(_KNOWN))):
        color = _OTHERS[index % len(_OTHERS)]
        marker = _OTHER_MARKERS[(index // len(_OTHERS) + index) % len(_OTHER_MARKERS)]
        styles[name] = Style(name, color, marker=marker, line=":")
    return styles


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with what it shows."""

    name: str  # of its files, without the suffix
    alt: str  # what it shows, for those who do not see it
    figure: Figure
    data: pd.DataFrame  # the numbers that are drawn


@contextmanager
def drawing() -> Iterator[None]:
    """Draw and write figures in the style of all, whatever the user's own is."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


def new_figure(height: float) -> Figure:
    """Return a figure of the page's width and a height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def curves(
    name: str, data: pd.DataFrame, *, styles: Styles, across: str, up: str | Mapping[str, str]
) -> Picture | None:
    """Return a panel a value of the first column, with a line and a band for each of the second.

    The third column is x; the last three are the band's lower edge, the line and the upper edge.
    across: label of x. up: of y in all panels, which then have titles, or in each. None of no row.
    """
    if data.empty:
        return None
    _, by, x, *_, low, y, high = data.columns
    figure, panels = _panels(data)
    for axis, value, shown, lowest in panels:
        at = sorted(shown[x].unique())
        for index, (key, style) in enumerate(styles.items()):
            own = shown[shown[by] == key].set_index(x)
            if own.empty:
                continue
            own = own[[low, y, high]].astype(float).reindex(at)  # a gap without a number
            every = max(1, len(at) // 12)
            axis.fill_between(at, own[low], own[high], color=style.color, alpha=0.12, lw=0)
            axis.plot(at, own[y], markevery=(index % every, every), **style.looks)
        positive_scale(axis, pd.concat([shown[low], shown[high]]))
        axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        title, label = (value.replace("_", " "), up) if isinstance(up, str) else ("", up[value])
        axis.set(title=title, xlabel=across if lowest else "", ylabel=label)
    drawn = [style for key, style in styles.items() if (data[by] == key).any()]
    handles = [Line2D([], [], label=style.title, **style.looks) for style in drawn]
    place: Any = {"loc": "outside lower center", "ncols": min(len(drawn), 5), "handlelength": 2.6}
    figure.legend(handles=handles, **place)
    numbers = up if isinstance(up, str) else " and ".join(up.values())
    titles = ", ".join(style.title for style in drawn)
    return Picture(name, f"{numbers} by {across}: {y} of {titles}.", figure=figure, data=data)


def boxes(name: str, data: pd.DataFrame, *, styles: Styles, label: str) -> Picture | None:
    """Return a panel a value of the first column, with a box of the last for each of the second.

    label: of the numbers in the last column. None without a row.
    """
    if data.empty:
        return None
    by, y = data.columns[1], data.columns[-1]
    figure, panels = _panels(data)
    titles = [style.title for style in styles.values()]
    for axis, value, shown, lowest in panels:
        for index, (key, style) in enumerate(styles.items()):
            axis.boxplot(
                shown.loc[shown[by] == key, y],
                positions=[index],
                widths=0.7,
                patch_artist=True,
                boxprops={"facecolor": style.color, "linewidth": 0.8},
                medianprops={"color": "#222222", "linewidth": 1.5},
                flierprops={"marker": "D", "markersize": 3.0, "markerfacecolor": style.color},
            )
        positive_scale(axis, shown[y])
        axis.set(title=value.replace("_", " "), ylabel=label)
        axis.set_xticks(range(len(styles)), titles if lowest else [], rotation=40, ha="right")
        axis.grid(axis="x", visible=False)
    return Picture(
        name,
        f"Box plots of {label}: a box for each of {', '.join(titles)}.",
        figure=figure,
        data=data,
    )


def _panels(data: pd.DataFrame) -> tuple[Figure, list[tuple[Axes, str, pd.DataFrame, bool]]]:
    """Return a panel a value of the first column: axes, value, rows, whether it is the lowest."""
    column = data.columns[0]
    names = list(dict.fromkeys(data[column]))
    across = min(3, len(names))
    down = math.ceil(len(names) / across)
    figure = new_figure(0.9 + 3.6 * down)
    panels = []
    for place, value in enumerate(names):
        axis = figure.add_subplot(down, across, place + 1)
        panels.append((axis, value, data[data[column] == value], place >= len(names) - 3))
    return figure, panels


def positive_scale(axes: Axes, values: pd.Series) -> None:
    """Set a logarithmic y axis for these numbers, linear below the least above zero."""
    positive = values[values > 0.0]
    if positive.empty:
        return
    if values.min() > 0.0:
        axes.set_yscale("log")
    else:
        axes.set_yscale("symlog", linthresh=positive.min())
    ticks = axes.yaxis
    written = FuncFormatter(lambda value, _: f"{value:g}")
    ticks.set_major_formatter(written)
    few = positive.max() < 60.0 * positive.min()  # hardly two powers of ten are in view
    if few and values.min() > 0.0:
        ticks.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        ticks.set_minor_formatter(written)
    else:
        ticks.set_minor_formatter(NullFormatter())


def write_picture(picture: Picture, folder: Path, *, kind: str) -> tuple[Path, Path]:
    """Write the figure in one of the FORMATS, without a clock, and its data as CSV beside it."""
    path = folder / f"{picture.name}.{kind}"
    data = folder / f"{picture.name}.csv"
    with whole_file(path) as beside:
        picture.figure.savefig(beside, format=kind, dpi=_DPI, metadata=_NO_CLOCKS[kind])
    with whole_file(data) as beside:
        picture.data.to_csv(beside, index=False, lineterminator="\n")
    return path, data
