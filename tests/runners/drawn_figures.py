"""Reading the data of a drawn figure back from its axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from chsel.methods.anchored.anchored_settings import AnchoredSettings, Effort
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply
from runners.reporting.method_style import MethodStyle

Bands = dict[float, tuple[float, float, float]]
"""Lower quartile, median and upper quartile by the place on the x axis."""


SMALL_SEARCH = AnchoredSettings(
    effort=Effort(
        samples=5_000,
        kept=40,
        first_steps=6,
        refined=20,
        steps=6,
        descents=8,
        descent_moves=20,
        chains=8,
        moves=40,
        polished=4,
        polish_moves=40,
    )
)
"""Of method=anchored, for pictures whose poses need not be good."""


def line_of(axes: Axes, style: MethodStyle) -> Line2D:
    """The one line that has the color of a method."""
    (line,) = (line for line in axes.lines if line.get_color() == style.color)
    return line


def bands_of(axes: Axes, style: MethodStyle) -> Bands:
    """What the line and the band of a method show; without the places where it has a gap."""
    line = line_of(axes, style)
    (band,) = (
        one
        for one in axes.collections
        if isinstance(one, PolyCollection) and to_hex(one.get_facecolor()[0]) == style.color
    )
    corners = np.concatenate([path.vertices for path in band.get_paths()])
    shown: Bands = {}
    for x, median in np.column_stack(line.get_data()).tolist():
        if np.isfinite(median):
            heights = corners[corners[:, 0] == x, 1]
            shown[x] = (float(heights.min()), median, float(heights.max()))
    return shown


def legend_of(figure: Figure) -> dict[str, tuple[object, object, object]]:
    """Color, marker and line style by the text of the figure's legend."""
    (legend,) = figure.legends
    return {
        text.get_text(): (line.get_color(), line.get_marker(), line.get_linestyle())
        for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)
    }


def outlines_of(axes: Axes) -> list[tuple[FloatArray, str, str]]:
    """Vertices (N, 2), color and line style of every outline, in the order of drawing."""
    return [
        (
            np.concatenate([path.vertices for path in outline.get_paths()]),
            to_hex(outline.get_edgecolor()[0]),
            "solid" if outline.get_linestyles()[0][1] is None else "dashed",
        )
        for outline in axes.collections
        if isinstance(outline, QuadContourSet)
    ]


def check_outlines(
    axes: Axes,
    mesh: trimesh.Trimesh,
    poses: Sequence[FloatArray],
    color: str,
    truth: FloatArray | None,
) -> None:
    """The panel, from the side, has the mesh's outlines in these poses world_from_object, in order.

    The one in the true pose is a black broken line above them.
    """
    lower, upper = np.transpose([axes.get_xlim(), axes.get_ylim()])
    outlines = outlines_of(axes)
    assert len(outlines) == len(poses) + 1
    assert [look for _, *look in outlines[:-1]] == [[color, "solid"]] * len(poses)
    assert outlines[-1][1:] == ("#000000", "dashed")
    for (vertices, _, _), pose in zip(outlines, [*poses, truth], strict=True):
        corners = apply(pose, np.asarray(mesh.vertices))[:, [0, 2]]
        in_view = np.clip([corners.min(axis=0), corners.max(axis=0)], lower, upper)
        drawn = [vertices.min(axis=0), vertices.max(axis=0)]
        np.testing.assert_allclose(drawn, in_view, atol=2.5 * (upper - lower).max() / 160.0)
