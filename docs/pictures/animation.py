"""`python -m docs.pictures.animation OUT.webp TITLE=RECORDING ...`: sessions side by side."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import SurfaceDistance, surface_points
from chsel.problem.poses import inverse
from chsel.problem.streams import StreamKey
from docs.pictures.outlines import CONTACT, TRUE_POSE, Frame, Outlines, as_image, corners_in
from replay.events import Probe
from replay.mcap.reader import read_recording
from replay.rerun.scene import coarsened, deepest
from runners.reporting.figures import drawing, positive_scale

_SIZE, _DPI = (9.0, 6.6), 80  # inches, and pixels of one
_PANELS = 0.69  # height of a session's panel in that of the figure
_COLORS = ("#0072b2", "#d55e00", "#009e73")  # of the sessions
_HAND, _PATH, _PAST, _FORECAST = "#999999", "#555555", "#aaaaaa", "#cc79a7"
_ON_THE_WAY = (0.4, 0.75, 1.0)  # of the hand's way to where it is deepest, a frame each
_MOVING, _SHOWN, _QUICK, _LAST = 120, 600, 180, 4000  # milliseconds of a frame


class _Session:
    """What is drawn of a recording."""

    def __init__(self, title: str, file: str, color: str) -> None:
        recording = read_recording(Path(file))
        start = recording.start
        self.title, self.color, self.start = title, color, start
        self.probes = list(recording.probes)
        points = surface_points(start.mesh, 500, StreamKey(start.seed, 0))
        distance = SurfaceDistance(start.sdf, start.mesh, points)
        self.poses, self.errors = {}, {}  # by step: world_from_object (B, 4, 4), and mm
        for step in recording.steps:
            found = recording.hypotheses(step)
            kept = found.object_from_world[~found.duplicate]
            squared = distance.between(kept, start.world_from_object[None])
            self.poses[step], self.errors[step] = inverse(kept), np.sqrt(squared.mean())
        self.forecasts = {}  # by step of the probe: where it was to meet the object (M, 3)
        for step in recording.decision_steps:
            met = recording.decision(step).decision.contacts
            self.forecasts[step + 1] = met[np.isfinite(met).all(axis=1)]
        self.hand = None if recording.offered is None else coarsened(recording.offered.hand)

    def contacts(self, done: int) -> FloatArray:
        """Those of so many probes (C, 3)."""
        return np.concatenate([np.zeros((0, 3)), *(p.contacts for p in self.probes[:done])])

    def results(self, done: int) -> list[tuple[int, int]]:
        """Number of probes and step of each result."""
        steps = [probe.step for probe in self.probes[:done]]
        return [(n + 1, step) for n, step in enumerate(steps) if step in self.poses]


def _draw(
    panel: Axes,
    outlines: Outlines,
    session: _Session,
    hand: Outlines | None,
    done: int,
    part: float,
) -> None:
    """A session after so many probes, and a part of the way of the next one."""
    frame, results = outlines.frame, session.results(done)
    title = f"{session.title}: {done} probes{', ended' if done == len(session.probes) else ''}"
    if results:
        step = results[-1][1]
        for pose in session.poses[step]:
            outlines.draw(panel, pose, session.color, linewidths=0.8, alpha=0.4)
        title += f", error {session.errors[step]:.0f} mm"
    truth = session.start.world_from_object
    outlines.draw(panel, truth, TRUE_POSE, linewidths=1.6, linestyles="dashed")
    for probe in session.probes[:done]:
        _path(panel, frame, probe, color=_PAST, linewidth=0.7)
    if part and done < len(session.probes):
        probe = session.probes[done]
        forecast = frame.flat(session.forecasts.get(probe.step, np.zeros((0, 3))))
        panel.plot(*forecast.T, ".", color=_FORECAST, markersize=5.0, zorder=5.0)
        _path(panel, frame, probe, color=_PATH, linewidth=1.6)
        if hand is not None and len(probe.gripper_path):
            way = probe.gripper_path[: deepest(probe.gripper_path) + 1]
            hand.fill(panel, way[round(part * (len(way) - 1))], _HAND)
    panel.plot(*frame.flat(session.contacts(done)).T, **CONTACT)
    panel.set_title(title)
    frame.set_on(panel)


def _path(panel: Axes, frame: Frame, probe: Probe, **look: object) -> None:
    if len(probe.gripper_path):
        way = probe.gripper_path[: deepest(probe.gripper_path) + 1, :3, 3]
        panel.plot(*frame.flat(way).T, zorder=4.0, **look)


def _curves(panel: Axes, sessions: Sequence[_Session], done: int) -> None:
    errors = [error for session in sessions for error in session.errors.values()]
    most = max(len(session.probes) for session in sessions)
    panel.set(xlim=(0.5, most + 0.5), xlabel="probes", ylabel="error in mm")
    positive_scale(panel, pd.Series(errors))
    panel.set_ylim(0.8 * min(errors), 1.25 * max(errors))
    for session in sessions:
        results = session.results(done)
        errors = [session.errors[step] for _, step in results]
        panel.plot([n for n, _ in results], errors, color=session.color, marker="o", markersize=3)
    panel.plot([], [], color=TRUE_POSE, linestyle="--", label="true pose")
    panel.plot([], [], **CONTACT, label="contacts")
    panel.plot([], [], ".", color=_FORECAST, label="forecast contacts")
    panel.legend(loc="center left", bbox_to_anchor=(1.03, 0.4))


def webp(frames: Sequence[Image.Image], milliseconds: Sequence[int], path: Path) -> None:
    """Write frames of one size, each shown for its time, again and again."""
    stream = io.BytesIO()
    first, *others = (frame.convert("RGB") for frame in frames)
    looks = {"duration": list(milliseconds), "loop": 0, "quality": 62, "method": 6}
    first.save(stream, format="webp", save_all=True, append_images=others, **looks)
    path.write_bytes(stream.getvalue())


def main(out: str, *named: str) -> None:
    """Up to three sessions of one object; after the first has ended, the others go on quickly."""
    titles = [text.split("=", 1) for text in named]
    sessions = [_Session(*pair, color) for pair, color in zip(titles, _COLORS, strict=False)]
    start, counts = sessions[0].start, [len(session.probes) for session in sessions]
    poses = np.concatenate([found for s in sessions for found in s.poses.values()])
    corners = np.quantile(corners_in(start.mesh, poses), [0.03, 0.97], axis=0)
    truth = corners_in(start.mesh, [start.world_from_object])
    known = [session.contacts(len(session.probes)) for session in sessions]
    aspect = _PANELS * _SIZE[1] / (_SIZE[0] / len(sessions))
    frame = Frame.around("oblique", [corners, truth, *known], 0.06, aspect)
    mesh = next((session.hand for session in sessions if session.hand is not None), None)
    hand = None if mesh is None else Outlines(mesh, frame)
    outlines, frames, times = Outlines(start.mesh, frame), [], []
    with drawing():
        for done in range(max(counts)):
            parts = _ON_THE_WAY if done < min(counts) else ()
            shown = _LAST if done + 1 == max(counts) else _SHOWN if parts else _QUICK
            moments = [(done, part, _MOVING) for part in parts] + [(done + 1, 0.0, shown)]
            for after, part, milliseconds in moments:
                figure = Figure(figsize=_SIZE)
                FigureCanvasAgg(figure)
                for n, session in enumerate(sessions):
                    width = 1.0 / len(sessions)
                    panel = figure.add_axes((n * width, 0.25, width, _PANELS))
                    _draw(panel, outlines, session, hand, min(after, counts[n]), part)
                _curves(figure.add_axes((0.09, 0.085, 0.62, 0.15)), sessions, after)
                frames.append(as_image(figure, _DPI))
                times.append(milliseconds)
    webp(frames, times, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
