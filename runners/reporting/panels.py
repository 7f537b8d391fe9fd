"""Figures: their size, axes and bytes, the same on every machine and for every user."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from runners.reporting.method_style import MethodStyle

WIDTH = 12.0  # inches, of every figure
_DPI = 120
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
}


@contextmanager
def drawing() -> Iterator[None]:
    """Draw in the report's style, whatever the user's own is."""
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


def png(figure: Figure) -> bytes:
    """The file, without anything that tells when and with what it was made."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


def drawn(draw: Callable[[], Figure]) -> bytes:
    """The file of a figure that is drawn in the report's style."""
    with drawing():
        return png(draw())


def legend_of_methods(figure: Figure, styles: Sequence[MethodStyle]) -> None:
    """One legend of methods for all panels, below them."""
    handles = [_handle(style) for style in styles]
    columns = min(len(styles), 5)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=2.6)


def positive_scale(axes: Axes, values: Sequence[float], axis: str = "y") -> None:
    """A logarithmic axis; linear below the least number above zero where there are zeros."""
    positive = [value for value in values if value > 0.0]
    if not positive:
        return
    scale: Any = axes.set_yscale if axis == "y" else axes.set_xscale
    if min(values) > 0.0:
        scale("log")
    else:
        scale("symlog", linthresh=min(positive))
    ticks = axes.yaxis if axis == "y" else axes.xaxis
    written = FuncFormatter(lambda value, _: f"{value:g}")
    ticks.set_major_formatter(written)
    few = max(positive) < 60.0 * min(positive)  # hardly two powers of ten are in view
    if few and min(values) > 0.0:
        ticks.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        ticks.set_minor_formatter(written)
    else:
        ticks.set_minor_formatter(NullFormatter())


def _handle(style: MethodStyle) -> Line2D:
    looks: Any = {"color": style.color, "marker": style.marker, "linestyle": style.line}
    return Line2D([], [], label=style.title, **looks)
