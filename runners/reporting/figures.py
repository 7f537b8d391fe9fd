"""Figures: style, panels and files, the same on every machine and for every user."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
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
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from replay.files import whole_file
from runners.reporting.method_style import MethodStyle

WIDTH = 12.0  # inches, of every figure
FORMATS = ("png", "svg", "pdf")
_DPI = 120
_TITLE = 0.35  # inches that a figure is taller with a title
_COLORS = 256  # of a small PNG file
# Metadata that is left out: when and with what a file was made.
_NO_CLOCKS: dict[str, Any] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
_STYLE: Any = {
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


class NotDrawn(Exception):
    """Why there is no picture."""


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
        matplotlib.rcParams.update(_STYLE)
        yield


def new_figure(height: float) -> Figure:
    """A figure of the page's width and a height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels(count: int, *, columns: int = 3, row_height: float = 3.3) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels, with room for a legend below."""
    columns = min(columns, max(count, 1))
    rows = max(1, math.ceil(count / columns))
    figure = new_figure(0.9 + row_height * rows)
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(count)]


def set_title(figure: Figure, title: str) -> None:
    """A title above all panels, which keep their size."""
    figure.set_figheight(figure.get_figheight() + _TITLE)
    figure.suptitle(title)


def file_content(figure: Figure, kind: str = "png") -> bytes:
    """A file of one of the FORMATS, without anything that tells when and with what it was made."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=_DPI, metadata=_NO_CLOCKS[kind])
    return stream.getvalue()


def small_png(picture: bytes | Image.Image) -> bytes:
    """A picture (of a PNG file, or an image) in few colours, as a PNG file."""
    image = Image.open(io.BytesIO(picture)) if isinstance(picture, bytes) else picture
    stream = io.BytesIO()
    few = image.convert("RGB").quantize(
        _COLORS,
        method=Image.Quantize.FASTOCTREE,  # which keeps colours of few pixels, such as contacts
        dither=Image.Dither.NONE,
    )
    few.save(stream, format="png", optimize=True)
    return stream.getvalue()


def write_picture(
    picture: Picture,
    folder: Path,
    kind: str,
    *,
    accepted: str = "a folder that can be written",
    small: bool = False,
) -> tuple[Path, Path]:
    """Write the figure as a file of one of the FORMATS, and its data as CSV beside it.

    accepted: the end of the error if the folder cannot be written. small: a PNG file of few
    colours. Returns both files.
    """
    content = file_content(picture.figure, kind)
    content = small_png(content) if small and kind == "png" else content
    path, data = folder / f"{picture.name}.{kind}", folder / f"{picture.name}.csv"
    with whole_file(path, accepted) as beside:
        beside.write_bytes(content)
    with whole_file(data, accepted) as beside:
        picture.data.to_csv(beside, index=False, lineterminator="\n")
    return path, data


def legend_of_methods(figure: Figure, styles: Sequence[MethodStyle]) -> None:
    """One legend of methods for all panels, below them."""
    handles = [_handle(style) for style in styles]
    columns = min(len(styles), 5)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=2.6)


def _handle(style: MethodStyle) -> Line2D:
    looks: Any = {"color": style.color, "marker": style.marker, "linestyle": style.line}
    return Line2D([], [], label=style.title, **looks)


def draw_quartiles(
    axes: Axes, found: pd.DataFrame, style: MethodStyle, *, alpha: float, **line: Any
) -> None:
    """A line of medians and a band between the quartiles of `spreads`, over their index."""
    found = found.astype(float)
    at = found.index.to_numpy(dtype=float)
    axes.fill_between(
        at, found["lower"], found["upper"], color=style.color, alpha=alpha, linewidth=0
    )
    looks: Any = {"color": style.color, "marker": style.marker, "linestyle": style.line}
    axes.plot(at, found["median"], **looks, **line)


def positive_scale(axes: Axes, values: pd.Series, axis: str = "y") -> None:
    """A logarithmic axis for these numbers; linear below the least above zero where zeros are."""
    positive = values[values > 0.0]
    if positive.empty:
        return
    scale: Any = axes.set_yscale if axis == "y" else axes.set_xscale
    if values.min() > 0.0:
        scale("log")
    else:
        scale("symlog", linthresh=positive.min())
    ticks = axes.yaxis if axis == "y" else axes.xaxis
    written = FuncFormatter(lambda value, _: f"{value:g}")
    ticks.set_major_formatter(written)
    few = positive.max() < 60.0 * positive.min()  # hardly two powers of ten are in view
    if few and values.min() > 0.0:
        ticks.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        ticks.set_minor_formatter(written)
    else:
        ticks.set_minor_formatter(NullFormatter())
