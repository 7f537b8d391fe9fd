"""The views of Rerun recordings, and how the viewer lays them out, so that it needs no click."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import encodings

from chsel.problem.points import Workspace
from replay.colors import BACKGROUND, GRID
from replay.rerun.scene import CUMULATIVE
from replay.rerun.stream import ITERATION, PROBE

TITLES: Mapping[str, str] = {
    "decision/spread": "Spread and its forecast [mm]",
    "decision/hit": "Hit: chance and outcome",
    "decision/surprise": "Surprise [nats]",
    "cost": "Cost by probe",
    "search": "by iteration",
    "error/position": "Position error [mm]",
    "error/rotation": "Rotation error [°]",
    "trust": "Spread and noise [mm]",
    "distinct": "Distinct",
    "measured": "Other",
    "seconds": "Seconds by stage",
}
"""Title of the view of the curves below each entity."""
_COLUMNS = (  # of the views below the scene, those that have something to show
    (rrb.Vertical, ("decision/spread",)),
    (rrb.Vertical, ("decision/hit", "decision/surprise")),
    (rrb.Tabs, ("cost", "search")),
    (rrb.Vertical, ("error/position", "error/rotation")),
    (rrb.Tabs, ("trust", "distinct", "measured")),
    (rrb.Vertical, ("seconds",)),
)
_DIRECTION = np.array([-0.55, -0.72, 0.42])  # of the eye from the workspace; probes move along +x
_DISTANCE = 1.05  # of the eye, in diagonals of the workspace
_STEERED = 1.25  # times as far, as actions start beyond the workspace
_SENSORS_SHARE = 4.6  # of all other views, where a column of pictures has 1
_IN_A_COLUMN = 4  # pictures
_PROBES_PER_SECOND = 4.0  # when the session is played
_GRID_LINES = 5  # at least these across the diagonal of the workspace


def session_blueprint(
    workspace: Workspace,
    *,
    curves: Collection[str] = (),
    archive: tuple[int, int] | None = None,
    sensors: Mapping[str, str] | None = None,
    steered: bool = False,
) -> rrb.Blueprint:
    """Return the layout: scene, archive and text above, curves below.

    curves: entities of TITLES that have something to show. archive: width and height of the heat
    map in cells, if there is one. sensors: titles of the pictures beside all, by sensor.
    """
    above: list[rrb.View | rrb.Container] = [
        scene_view(workspace, distance=_STEERED if steered else 1.0)
    ]
    if archive is not None:
        above.append(_archive_view(*archive))
    above.append(_text_views())
    shares = [9.5, 6.5, 4.5] if archive is not None else [10.0, 4.0]
    columns = [(kind, [name for name in names if name in curves]) for kind, names in _COLUMNS]
    below = [kind(*map(_session_curves, names)) for kind, names in columns if names]
    views: rrb.Container = rrb.Vertical(
        rrb.Horizontal(*above, column_shares=shares), rrb.Horizontal(*below), row_shares=[65, 35]
    )
    if sensors:
        pictures = [
            rrb.Spatial2DView(origin=f"/sensors/{sensor}", name=title, background=BACKGROUND)
            for sensor, title in sensors.items()
        ]
        count = 1 if len(pictures) <= _IN_A_COLUMN else 2
        beside = rrb.Grid(*pictures, grid_columns=count)
        views = rrb.Horizontal(views, beside, column_shares=[_SENSORS_SHARE, count])
    return at_last_probe(views)


def at_last_probe(views: rrb.Container) -> rrb.Blueprint:
    """Return the views alone, all panels collapsed, at the last probe and following what comes."""
    time = rrb.TimePanel(
        state="collapsed", timeline=PROBE, play_state="following", fps=_PROBES_PER_SECOND
    )
    return rrb.Blueprint(views, time, collapse_panels=True)


def scene_view(
    workspace: Workspace,
    *,
    name: str = "Scene",
    more: Sequence[str] = (),
    distance: float = 1.0,
) -> rrb.Spatial3DView:
    """Return the scene, looked at obliquely from where the probes come from.

    more: entities beside it that the view shows too, each with all below it. distance: of the eye,
    times what has the workspace in sight.
    """
    lower, upper = workspace.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    centre = (lower + upper) / 2
    away = _DIRECTION / np.linalg.norm(_DIRECTION)
    return rrb.Spatial3DView(
        origin="/scene",
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
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + distance * _DISTANCE * diagonal * away,
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
        ),
        overrides={f"/scene/{path}": _up_to_now() for path in CUMULATIVE},
    )


def curves_view(root: str, name: str, *, legend: bool = True) -> rrb.TimeSeriesView:
    """Return the curves under the entity `root`."""
    return rrb.TimeSeriesView(
        origin=f"/{root}",
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
    )


def _session_curves(root: str) -> rrb.TimeSeriesView:
    return curves_view(root, TITLES[root])


def _archive_view(width: int, height: int) -> rrb.Spatial2DView:
    """Return the heat map; the mouse finds its costs, not its colours."""
    room = 0.2 * max(width, height)  # for the text
    return rrb.Spatial2DView(
        origin="/archive",
        name="Archive: lowest cost by cell; dots: hypotheses",
        background=BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-room, width + room), y_range=(-room, height + room)
        ),
        overrides={"/archive/colors": rrb.EntityBehavior(interactive=False)},
    )


def _text_views() -> rrb.Container:
    columns = rrb.TextLogColumns(
        timeline_columns=[encodings.TimelineColumn(PROBE, visible=False)],
        text_log_columns=[
            encodings.TextLogColumn(encodings.TextLogColumnKind.LogLevel, visible=True),
            encodings.TextLogColumn(encodings.TextLogColumnKind.Body, visible=True),
        ],
    )
    return rrb.Vertical(
        rrb.TextDocumentView(origin="/result", name="Result"),
        rrb.Tabs(
            rrb.TextDocumentView(origin="/session", name="Session"),
            rrb.TextDocumentView(origin="/colors", name="Colours"),
        ),
        rrb.TextLogView(origin="/log", name="Log", columns=columns),
        row_shares=[4, 3, 3],
    )


def _up_to_now() -> rrb.VisibleTimeRanges:
    """Return all moments from the first one to that of the cursor, on every timeline."""
    start = rrb.TimeRangeBoundary.infinite()
    end = rrb.TimeRangeBoundary.cursor_relative(seq=0)
    return rrb.VisibleTimeRanges(
        [rrb.VisibleTimeRange(name, start=start, end=end) for name in (PROBE, ITERATION)]
    )
