"""How the viewer lays out a comparison of methods: a view each, curves of all below."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb

from chsel.problem.points import Workspace
from replay.rerun.blueprint import (
    Bounds,
    at_first_registration,
    curves_view,
    legend_view,
    plane_view,
    scene_view,
)
from replay.rerun.plane import Frame

SUMMARY_FRAME = Frame(12.0, 1.2)
"""Size of the text below a 3-D view, in units of its view."""

CURVES: Mapping[str, str] = {
    "log10_best_cost": "log₁₀ best cost",
    "best_cost": "best cost",
    "log10_median_cost": "log₁₀ median",
    "median_cost": "median",
    "spread": "Spread [mm]",
    "best_position_error": "Position error of the best [mm]",
    "best_rotation_error": "Rotation error of the best [°]",
    "closest_position_error": "Position error of the closest [mm]",
    "closest_rotation_error": "Rotation error of the closest [°]",
}
"""What is drawn over probes, a curve for each method: name of the number, title of the view."""

_WITH_LEGEND = "spread"  # of the view at the right edge: one legend serves all
_IN_A_ROW = 4
_SUMMARIES = 10.0  # so many texts of two lines are as high as all views of methods
_LONGEST = 40


def entity_names(labels: Sequence[str]) -> dict[str, str]:
    """A part of an entity path for each label: no two the same, and no sign that paths escape."""
    names: dict[str, str] = {}
    for label in labels:
        bare = re.sub(r"[^A-Za-z0-9_-]+", "_", label)[:_LONGEST] or "_"
        name, count = bare, 1
        while name in names.values():
            count += 1
            name = f"{bare}-{count}"
        names[label] = name
    return names


def comparison_blueprint(
    workspace: Workspace,
    names: Mapping[str, str],
    *,
    pose_known: bool,
    in_sight: Bounds | None = None,
) -> rrb.Blueprint:
    """A view for each method, four in a row at most; names: their entity paths, by label.

    in_sight: what fills each view; by default the workspace.
    """
    columns = len(names) if len(names) <= _IN_A_ROW else math.ceil(math.sqrt(len(names)))
    share = max(_SUMMARIES / math.ceil(len(names) / columns) - 1.0, 1.0)
    cells = [
        _method_views(workspace, in_sight, label, name, share) for label, name in names.items()
    ]
    above = rrb.Grid(*cells, grid_columns=columns)
    below = rrb.Horizontal(*_curve_views(pose_known=pose_known))
    return at_first_registration(rrb.Vertical(above, legend_view(), below, row_shares=[57, 7, 36]))


def _method_views(
    workspace: Workspace, in_sight: Bounds | None, label: str, name: str, share: float
) -> rrb.Container:
    """The scene, `share` times as high as the text below it."""
    scene = scene_view(workspace, name=label, in_sight=in_sight, more=[f"hypotheses/{name}"])
    margins = (0.0, 0.0, 0.0, 0.0)
    root = f"summary/{name}"
    summary = plane_view(root, f"{label}: result", SUMMARY_FRAME, margins, titlebar=False)
    return rrb.Vertical(scene, summary, row_shares=[share, 1.0])


def _curve_views(*, pose_known: bool) -> list[rrb.View | rrb.Container]:
    def view(name: str) -> rrb.View:
        return curves_view(f"curves/{name}", CURVES[name], legend=name == _WITH_LEGEND)

    views: list[rrb.View | rrb.Container] = [
        rrb.Tabs(view(f"log10_{cost}"), view(cost)) for cost in ("best_cost", "median_cost")
    ]
    if pose_known:
        for which in ("best", "closest"):
            errors = [view(f"{which}_{kind}_error") for kind in ("position", "rotation")]
            views.append(rrb.Vertical(*errors))
    views.append(view("spread"))
    return views
