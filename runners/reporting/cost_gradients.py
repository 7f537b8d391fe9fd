"""Where the relaxed cost pushes points, on a cross-section of the object."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import build_settings
from replay.mcap.reader import read_recording
from replay.settings_migration import completed
from runners.reporting.figures import NotDrawn, Picture, new_figure
from runners.reporting.section import Section, Subject, drawn
from runners.reporting.shown_trial import shown_trial
from runners.reporting.silhouette import VIEWS, Frame, point_table

_ALONG = 22  # samples along the longer side of the picture
_MARGIN = 0.04  # metres around the object
_KINDS = {
    "free": ("free points leave the object", "#c1272d"),
    "occupied": ("occupied points enter it", "#7b3fa0"),
    "known": ("surface points go to its surface", "#111111"),
}


def cost_gradients(subject: Subject) -> Section | None:
    """Of the recording of the shown trial, by CHSEL if that is recorded; None as the sequence."""
    text = (
        "Where the negative gradient of the relaxed cost pushes a point, on the X-Z "
        "cross-section of the object (in its own frame) that holds most of it: free points in "
        "red, occupied points in purple, known surface points in black; grey dots are not pushed. "
        "The line is the zero level of the SDF, the broken one the penetration tolerance. Longer "
        "arrows are stronger pushes, to a scale of its own in each panel; free points as in the "
        "sum over free points (Eq. 8)."
    )

    def draw() -> Picture:
        evaluation, (trial, _) = subject.evaluation, shown_trial(subject)
        for method in ("chsel", *evaluation.methods):
            if path := evaluation.recording(trial, method):
                return picture_of_gradients(path)
        raise NotDrawn(f"there is no recording of {trial[0]}, seed {trial[1]}")

    picture, missing = drawn(draw)
    if picture is None and not subject.asks:
        return None
    return Section("gradients", "Gradients of the cost", text, picture, missing)


def picture_of_gradients(path: Path) -> Picture:
    """The picture from a recording's SDF and cost settings; NotDrawn where it has no cost."""
    try:
        start = read_recording(path).start
    except ChselError as error:
        raise NotDrawn(str(error)) from None
    settings = recorded_cost(start.config, start.method)
    settings = settings.of_object(start.sdf, start.free_resolution)
    alt = (
        f"Three cross-sections of the object {start.object} with arrows: free points inside of it "
        "are pushed outwards, occupied points outside of it inwards, and known points to the "
        "surface from both sides."
    )
    figure, data = _figure(start.sdf, settings)
    return Picture("gradients", alt, figure, data)


def recorded_cost(config: Mapping[str, object], method: str) -> CostSettings:
    """The settings of the relaxed cost in a recording's configuration."""
    method_config = config.get("method")
    cost = method_config.get("cost") if isinstance(method_config, Mapping) else None
    if not isinstance(cost, Mapping):
        raise NotDrawn(f"the recorded method, {method}, has no relaxed cost")
    try:
        return build_settings(CostSettings, completed(cost, CostSettings()), "method.cost")
    except ChselError as error:
        raise NotDrawn(f"the cost that the recording tells is none: {error}") from None


def point_gradients(
    sdf: SdfGrid, settings: CostSettings, points: FloatArray, kind: str
) -> FloatArray:
    """Gradient (P, 3) of the cost by each of the points (P, 3) alone, in the object's frame.

    A point at the world's origin is moved to x~ by the translation t = x~, so that the gradient
    by t is that by the point. Free points are each one of the sum of Eq. 8 here.
    """
    origin = np.zeros((1, 3))
    settings = replace(settings, free_term="direct")
    with warnings.catch_warnings():  # an object too thin for the tolerance has no free gradients
        warnings.simplefilter("ignore")
        cost = RelaxedCost(sdf, KnownPoints(**{kind: origin}), settings)
    rotations = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    translations = torch.tensor(points, requires_grad=True)
    (gradients,) = torch.autograd.grad(cost(rotations, translations).sum(), translations)
    gradients_by_point: FloatArray = gradients.numpy()
    return gradients_by_point


def section_plane(sdf: SdfGrid) -> int:
    """The index along y of the grid's nodes where most of them are inside of the object."""
    return int(np.argmax((sdf.values < 0.0).sum(axis=(0, 2))))


def _figure(sdf: SdfGrid, settings: CostSettings) -> tuple[Figure, pd.DataFrame]:
    j = section_plane(sdf)
    nodes = [sdf.origin[axis] + sdf.resolution * np.arange(sdf.shape[axis]) for axis in range(3)]
    inside = np.argwhere(sdf.values[:, j, :] < 0.0)
    margin = _MARGIN + sdf.resolution
    lower = sdf.origin[[0, 2]] + inside.min(axis=0) * sdf.resolution - margin
    upper = sdf.origin[[0, 2]] + inside.max(axis=0) * sdf.resolution + margin
    spacing = float((upper - lower).max()) / _ALONG
    x, z = np.meshgrid(
        *(np.arange(lower[i] + 0.5 * spacing, upper[i], spacing) for i in range(2)), indexing="ij"
    )
    points = np.stack([x.ravel(), np.full(x.size, nodes[1][j]), z.ravel()], axis=1)
    frame = Frame(VIEWS["xz"], lower, upper)
    figure = new_figure(float(np.clip(0.9 + 3.3 * frame.aspect, 3.0, 8.0)))
    figure.set_layout_engine("compressed")  # leaves room for titles above panels of fixed aspect
    data = []
    for place, (kind, (title, color)) in enumerate(_KINDS.items()):
        axes = figure.add_subplot(1, 3, place + 1)
        push = -point_gradients(sdf, settings, points, kind)
        _draw_arrows(axes, points, push, spacing, color)
        columns = {"push_x": push[:, 0], "push_z": push[:, 2]}
        data.append(point_table(points, points=kind).assign(**columns))
        section = sdf.values[:, j, :].T
        axes.contour(nodes[0], nodes[2], section, [0.0], colors="#1f6f8b", linewidths=2.0)
        if kind != "known":
            level = settings.alpha * (1.0 if kind == "free" else -1.0)
            style: Any = {"colors": "#1f6f8b", "linewidths": 1.0, "linestyles": "dashed"}
            if section.min() < level < section.max():
                axes.contour(nodes[0], nodes[2], section, [level], **style)
        axes.set_title(title)
        frame.set_on(axes, left=place == 0)
    return figure, pd.concat(data)


def _draw_arrows(
    axes: Axes, points: FloatArray, push: FloatArray, spacing: float, color: str
) -> None:
    """Arrows of 0.4 to 1.3 spacings; dots where nothing pushes."""
    x, z = points[:, 0], points[:, 2]
    length = np.sqrt(push[:, 0] ** 2 + push[:, 2] ** 2)
    pushed = length > 1e-12
    axes.scatter(x[~pushed], z[~pushed], s=3.0, color="#bbbbbb", linewidths=0)
    if not pushed.any():
        axes.text(0.5, 0.02, "nothing pushes here", transform=axes.transAxes, ha="center")
        return
    shown = spacing * (0.4 + 0.9 * length[pushed] / length.max()) / length[pushed]
    axes.scatter(x[pushed], z[pushed], s=5.0, color=color, linewidths=0)
    axes.quiver(
        x[pushed],
        z[pushed],
        push[pushed, 0] * shown,
        push[pushed, 2] * shown,
        color=color,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.005,
        headwidth=4.0,
        headlength=4.0,
        headaxislength=3.6,
    )
