"""Figures from data frames: lines with bands, boxes, and files that are the same everywhere."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
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
    """How a method or policy looks. color: "#rrggbb". marker, line: as matplotlib calls them."""

    title: str
    color: str
    marker: str
    line: str


Styles = Mapping[str, Style]
# Colours after Okabe and Ito, and Tol: apart for colour-blind eyes. Variants of a method share a
# hue, a lighter one and broken lines for the second.
_METHODS = {
    "chsel": Style("CHSEL", "#0072b2", "o", "-"),
    "chsel_cma_me": Style("CHSEL (CMA-ME)", "#56b4e9", "s", "--"),
    "gradient_descent": Style("Gradient descent", "#009e73", "^", "-"),
    "svgd": Style("SVGD", "#e69f00", "D", "-"),
    "icp": Style("ICP", "#6b6b6b", "P", "-"),
    "cvo": Style("CVO", "#b2451c", "v", "-"),
    "cvo_no_free_space": Style("CVO (no free space)", "#f08a5d", "<", "--"),
    "medial_constraint": Style("Medial Constraint", "#882255", "X", "-"),
    "medial_constraint_cma_me": Style("Medial Constraint (QD)", "#d889b8", "p", "--"),
}
_POLICIES = {
    "grid": Style("grid", "#222222", "s", "--"),
    "random": Style("random", "#999999", "d", "--"),
    "nearest_mean": Style("nearest mean", "#56b4e9", "^", "-"),
    "hit_chance": Style("hit chance", "#e69f00", "v", "-"),
    "voxel_entropy": Style("voxel entropy", "#882255", "D", "-"),
    "hypothesis_pruning": Style("hypothesis pruning", "#009e73", "X", "-"),
    "information": Style("information", "#0072b2", "o", "-"),
    "expected_loss": Style("expected loss", "#b2451c", "P", "-"),
}
_OTHERS = ("#117733", "#332288", "#999933", "#999999", "#661100", "#44aa99")
_OTHER_MARKERS = ("h", "d", ">", "8", "*", "H")


def method_styles(methods: Sequence[str]) -> dict[str, Style]:
    """The looks of methods in the order in which all figures have them: ours, then by name.

    A variant such as "chsel@paper" and a method from outside look the same in all figures of one
    report, by their place among the names.
    """
    return _styles(methods, _METHODS)


def policy_styles(policies: Sequence[str]) -> dict[str, Style]:
    """The looks of policies, likewise."""
    return _styles(policies, _POLICIES)


def _styles(names: Sequence[str], known: Styles) -> dict[str, Style]:
    styles = {name: style for name, style in known.items() if name in names}
    for index, name in enumerate(sorted(set(names) - set(known))):
        color = _OTHERS[index % len(_OTHERS)]
        marker = _OTHER_MARKERS[(index // len(_OTHERS) + index) % len(_OTHER_MARKERS)]
        styles[name] = Style(name, color, marker, ":")
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
    """A figure of the page's width and a height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def curves(
    name: str,
    alt: str,
    data: pd.DataFrame,
    styles: Styles,
    *,
    x: str,
    y: str,
    by: str,
    panel: str,
    labels: tuple[str, str | Mapping[str, str]],
) -> Picture:
    """A panel for each value of one column, with a line and a band for each value of another.

    data: besides columns `x`, `y`, `by` and `panel`, `lower` and `upper` of the bands.
    labels: of the x axis, and of the y axis for all panels, which then have titles, or for each.
    """
    names = list(dict.fromkeys(data[panel]))
    figure, axes = _panels(len(names))
    for place, (axis, value) in enumerate(zip(axes, names, strict=True)):
        shown = data[data[panel] == value]
        at = sorted(shown[x].unique())
        for index, (key, style) in enumerate(styles.items()):
            own = shown[shown[by] == key].set_index(x)
            if own.empty:
                continue
            own = own[["lower", y, "upper"]].astype(float).reindex(at)  # a gap without a number
            every = max(1, len(at) // 12)
            axis.fill_between(at, own["lower"], own["upper"], color=style.color, alpha=0.12, lw=0)
            axis.plot(
                at,
                own[y],
                color=style.color,
                marker=style.marker,
                linestyle=style.line,
                markevery=(index % every, every),
            )
        positive_scale(axis, pd.concat([shown["lower"], shown["upper"]]))
        axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        across, up = labels
        axis.set_title(value.replace("_", " ") if isinstance(up, str) else "")
        axis.set_xlabel(across if place >= len(names) - 3 else "")
        axis.set_ylabel(up if isinstance(up, str) else up[value])
    _legend(figure, [style for key, style in styles.items() if (data[by] == key).any()])
    return Picture(name, alt, figure, data)


def boxes(
    name: str,
    alt: str,
    data: pd.DataFrame,
    styles: Styles,
    *,
    y: str,
    by: str,
    panel: str,
    label: str,
) -> Picture:
    """A panel for each value of one column, with a box for each value of another.

    Boxes span the quartiles; whiskers reach to the last number within 1.5 boxes.
    """
    names = sorted(data[panel].unique())
    figure, axes = _panels(len(names))
    for place, (axis, value) in enumerate(zip(axes, names, strict=True)):
        shown = data[data[panel] == value]
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
        axis.set_title(value.replace("_", " "))
        axis.set_ylabel(label)
        names_below = [style.title for style in styles.values()]
        lowest = place >= len(names) - 3
        axis.set_xticks(range(len(styles)), names_below if lowest else [], rotation=40, ha="right")
        axis.grid(axis="x", visible=False)
    return Picture(name, alt, figure, data)


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Panels, three in a row, with room for a legend below."""
    columns = min(3, count)
    rows = math.ceil(count / columns)
    figure = new_figure(0.9 + 3.6 * rows)
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(count)]


def _legend(figure: Figure, styles: Sequence[Style]) -> None:
    """One legend for all panels, below them."""
    handles = []
    for style in styles:
        looks: Any = {"color": style.color, "marker": style.marker, "linestyle": style.line}
        handles.append(Line2D([], [], label=style.title, **looks))
    columns = min(len(styles), 5)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=2.6)


def positive_scale(axes: Axes, values: pd.Series) -> None:
    """A logarithmic y axis for these numbers; linear below the least above zero where zeros are."""
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


def file_content(figure: Figure, kind: str) -> bytes:
    """A file of one of the FORMATS, without anything that tells when and with what it was made."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=_DPI, metadata=_NO_CLOCKS[kind])
    return stream.getvalue()


def write_picture(
    picture: Picture, folder: Path, kind: str, *, accepted: str = "a folder that can be written"
) -> tuple[Path, Path]:
    """Write the figure as a file of one of the FORMATS, and its data as CSV beside it.

    accepted: the end of the error if the folder cannot be written. Returns both files.
    """
    path, data = folder / f"{picture.name}.{kind}", folder / f"{picture.name}.csv"
    with whole_file(path, accepted) as beside:
        beside.write_bytes(file_content(picture.figure, kind))
    with whole_file(data, accepted) as beside:
        picture.data.to_csv(beside, index=False, lineterminator="\n")
    return path, data
