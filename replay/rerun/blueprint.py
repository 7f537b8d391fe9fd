"""How the viewer lays a Rerun recording out, so that it needs no click."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import encodings

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Workspace
from chsel.problem.poses import apply, inverse
from chsel.problem.registration_problem import Hypotheses
from replay.colors import BACKGROUND, GRID
from replay.events import SessionStarted
from replay.rerun.clock import PROBE, REGISTRATION, TIMELINES
from replay.rerun.curves import SEARCH_FRAME
from replay.rerun.decisions import DECISION_CURVES
from replay.rerun.hypotheses import shown_hypotheses
from replay.rerun.legend import LEGEND_FRAME
from replay.rerun.plane import Frame
from replay.rerun.scene import CUMULATIVE
from replay.rerun.sensors import SensorPicture

Bounds = tuple[FloatArray, FloatArray]
"""Lower and upper corner (3,) of a box in the world, metres."""
_DIRECTION = np.array([-0.55, -0.72, 0.42])  # from the box; probes move along +x
_DISTANCE = 1.08  # in diagonals of the box
_STEERED = 1.25  # times as far, as actions start beyond the workspace
_LOOK_DOWN = 0.07  # in heights of the box, whose near corner would be cut off
_OUT_OF_SIGHT = 0.05  # of the hypotheses' corners, at either end of each axis
PlayState = Literal["paused", "following"]
USUAL_ARCHIVE = Frame(40, 40)
"""Cells of the map that is made room for until the first snapshot is there."""
_SENSORS_SHARE = 4.6  # of all other views, where a column of pictures has 1
_IN_A_COLUMN = 4
_PROBES_PER_SECOND = 4.0  # when the session is played
_GRID_LINES = 5  # at least these across the diagonal of the workspace


def session_blueprint(
    workspace: Workspace,
    *,
    pose_known: bool,
    in_sight: Bounds | None = None,
    archive: Frame | None = USUAL_ARCHIVE,
    timed: bool = False,
    steered: bool = False,
    sensors: Sequence[SensorPicture] = (),
    follow: bool = False,
) -> rrb.Blueprint:
    """Scene, archive and text above, curves below.

    in_sight: see `scene_view`. archive: size of the heat map in cells; None for a method without
    an archive. timed: whether there are wall-clock times to show. steered: whether there are
    decisions to show. sensors: of a robot session, their pictures beside all. follow: show the last
    probe, otherwise the first registration, which must be there then.
    """
    view = scene_view(workspace, in_sight=in_sight, distance=_STEERED if steered else 1.0)
    strips = [legend_view(), *([legend_view("score_legend", "Scores")] if steered else [])]
    scene = rrb.Vertical(view, *strips, row_shares=[9, *(1 for _ in strips)])
    upper: list[rrb.View | rrb.Container] = [scene, _text_views()]
    shares = [10.0, 4.0]
    if archive is not None:
        upper.insert(1, archive_view(archive))
        shares = [9.5, 6.5, 4.5]
    above = rrb.Horizontal(*upper, column_shares=shares)
    curves = _curve_views(pose_known=pose_known, timed=timed)
    below = rrb.Horizontal(*(_steered_views(curves) if steered else curves))
    views: rrb.Container = rrb.Vertical(above, below, row_shares=[65, 35])
    if sensors:
        columns = 1 if len(sensors) <= _IN_A_COLUMN else 2
        shares = [_SENSORS_SHARE, columns]
        views = rrb.Horizontal(views, _sensor_views(sensors, columns), column_shares=shares)
    return at_last_probe(views) if follow else at_first_registration(views)


def at_last_probe(views: rrb.Container) -> rrb.Blueprint:
    """The views alone, all panels collapsed, at the last probe and following what comes."""
    return _views_alone(views, PROBE, "following")


def at_first_registration(views: rrb.Container) -> rrb.Blueprint:
    """The views alone, all panels collapsed, at the first moment that has hypotheses."""
    return _views_alone(views, REGISTRATION, "paused")


def _views_alone(views: rrb.Container, timeline: str, play_state: PlayState) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline=timeline, play_state=play_state, fps=_PROBES_PER_SECOND
        ),
    )


def scene_view(
    workspace: Workspace,
    root: str = "scene",
    name: str = "Scene",
    *,
    in_sight: Bounds | None = None,
    more: Sequence[str] = (),
    distance: float = 1.0,
) -> rrb.Spatial3DView:
    """The scene under the entity `root`, looked at obliquely from where the probes come from.

    in_sight: what fills the view; by default the workspace.
    more: entities beside it that the view shows too, each with all below it. distance: of the eye,
    times what has that in sight.
    """
    lower, upper = workspace.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    return rrb.Spatial3DView(
        origin=f"/{root}",
        contents=["$origin/**", *(f"/{entity}/**" for entity in more)],
        name=name,
        background=rrb.Background(color=BACKGROUND, kind="SolidColor"),
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=10.0 ** np.floor(np.log10(diagonal / _GRID_LINES)),
            plane=rr.components.Plane3D((0.0, 0.0, 1.0), float(lower[2])),
            stroke_width=1.0,
            color=GRID,
        ),
        eye_controls=_eye_on(in_sight or (lower, upper), distance),
        overrides={f"/{root}/{path}": _up_to_now() for path in CUMULATIVE},
    )


def archive_view(
    frame: Frame,
    root: str = "archive",
    name: str = "Archive: lowest cost by cell; dots: hypotheses",
) -> rrb.Spatial2DView:
    """The heat map under the entity `root`; the mouse finds its costs, not its colours."""
    return plane_view(root, name, frame, (0.2, 0.28, 0.2, 0.24), inert=f"/{root}/colors")


def _sensor_views(sensors: Sequence[SensorPicture], columns: int) -> rrb.Container:
    """A picture for each sensor, one above the other."""
    views = [
        plane_view(f"sensors/{s.sensor}", s.title, s.frame, (0.02, 0.02, 0.14, 0.02))
        for s in sensors
    ]
    return rrb.Grid(*views, grid_columns=columns)


def legend_view(root: str = "legend", name: str = "Legend") -> rrb.Spatial2DView:
    """What the colours of the scene mean."""
    return plane_view(root, name, LEGEND_FRAME, (0.0, 0.0, 0.0, 0.0), titlebar=False)


def _curve_views(*, pose_known: bool, timed: bool) -> list[rrb.View | rrb.Container]:
    views: list[rrb.View | rrb.Container] = [
        rrb.Tabs(
            curves_view("cost", "Cost by probe"),
            curves_view("search", "by iteration", whole=False),
        ),
        plane_view("search_plot", "Cost of the search", SEARCH_FRAME, (0.22, 0.1, 0.28, 0.24)),
    ]
    if pose_known:
        errors = [("position", "Position error [mm]"), ("rotation", "Rotation error [°]")]
        views.append(rrb.Vertical(*(curves_view(f"error/{kind}", name) for kind, name in errors)))
    if timed:
        views.append(curves_view("seconds", "Seconds by stage"))
    views.append(
        rrb.Tabs(
            curves_view("trust", "Spread and noise [mm]"),
            curves_view("distinct", "Distinct"),
            curves_view("measured", "Other"),
        )
    )
    return views


def _steered_views(views: list[rrb.View | rrb.Container]) -> list[rrb.View | rrb.Container]:
    """The curves of decisions ahead of the others, whose plot of the search is behind costs."""
    root, names = "decision", DECISION_CURVES
    spread = curves_view(f"{root}/spread", names["spread"])
    hit = curves_view(f"{root}/hit", names["hit"], legend=False, y_range=(-0.05, 1.05))
    surprise = curves_view(f"{root}/surprise", names["surprise"], legend=False)
    costs, search, *others = views
    of_costs = rrb.Tabs(*costs.contents, search) if isinstance(costs, rrb.Tabs) else costs
    return [spread, rrb.Vertical(hit, surprise), *others, of_costs]


def _text_views() -> rrb.Container:
    columns = rrb.TextLogColumns(
        timeline_columns=[encodings.TimelineColumn(PROBE, visible=False)],
        text_log_columns=[
            encodings.TextLogColumn(encodings.TextLogColumnKind.LogLevel, visible=True),
            encodings.TextLogColumn(encodings.TextLogColumnKind.Body, visible=True),
        ],
    )
    return rrb.Vertical(
        rrb.TextDocumentView(origin="/session", name="Session"),
        rrb.TextDocumentView(origin="/verdict", name="Verdict"),
        rrb.TextLogView(origin="/log", name="Log", columns=columns),
        row_shares=[4, 3, 3],
    )


def curves_view(
    root: str,
    name: str,
    *,
    legend: bool = True,
    whole: bool = True,
    y_range: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """The curves under the entity `root`, whole or from the first moment to shortly after now.

    y_range: by default as the curves need it.
    """
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative(seq=4)
    return rrb.TimeSeriesView(
        origin=f"/{root}",
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        axis_y=None if y_range is None else rrb.ScalarAxis(range=y_range),
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=start if whole else now)),
    )


def plane_view(
    root: str,
    name: str,
    frame: Frame,
    margins: tuple[float, float, float, float],
    *,
    inert: str = "",
    titlebar: bool = True,
) -> rrb.Spatial2DView:
    """A drawing with room for its labels: left, right, top and bottom, in longer sides of it.

    inert: an entity that the mouse does not find.
    """
    side = max(frame.width, frame.height)
    left, right, top, bottom = (margin * side for margin in margins)
    return rrb.Spatial2DView(
        origin=f"/{root}",
        name=name,
        titlebar=titlebar,
        background=BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-left, frame.width + right), y_range=(-top, frame.height + bottom)
        ),
        overrides={inert: rrb.EntityBehavior(interactive=False)} if inert else None,
    )


def _up_to_now() -> rrb.VisibleTimeRanges:
    """All moments from the first one to that of the cursor, on every timeline."""
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative(seq=0)
    return rrb.VisibleTimeRanges(
        [rrb.VisibleTimeRange(name, start=start, end=end) for name in TIMELINES]
    )


def bounds_in_sight(started: SessionStarted, sets: Iterable[Hypotheses]) -> Bounds | None:
    """What most hypotheses take up of the workspace, with the object if its pose is known.

    None if there are no hypotheses.
    """
    shown = [found.object_from_world[shown_hypotheses(found)] for found in sets]
    poses = inverse(np.concatenate([np.zeros((0, 4, 4)), *shown]))
    if len(poses) == 0:
        return None
    if started.world_from_object is not None:
        poses = np.concatenate([poses, started.world_from_object[None]])
    import trimesh

    corners = trimesh.bounds.corners(started.mesh.bounds)
    places = np.concatenate([apply(pose, corners) for pose in poses])
    ends = np.quantile(places, [_OUT_OF_SIGHT, 1.0 - _OUT_OF_SIGHT], axis=0)
    lower, upper = np.clip(ends, *started.workspace.bounds)
    return lower, upper


def _eye_on(in_sight: Bounds, distance: float) -> rrb.EyeControls3D:
    """An eye that has a box in sight, obliquely from where the probes come from."""
    lower, upper = in_sight
    centre = (lower + upper) / 2
    away = _DIRECTION / np.linalg.norm(_DIRECTION) * np.linalg.norm(upper - lower)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre + distance * _DISTANCE * away,
        look_target=centre - (0.0, 0.0, _LOOK_DOWN * (upper[2] - lower[2])),
        eye_up=(0.0, 0.0, 1.0),
    )
