"""`python -m runners.reporting.probing_animation`: sessions side by side, probe by probe."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter
from PIL import Image

from chsel.errors import ChselError, SettingError, require_choice
from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import SurfaceDistance, surface_points
from chsel.problem.poses import inverse
from chsel.problem.streams import StreamKey
from replay.console import print_error, print_written
from replay.events import Probe, SessionStarted
from replay.files import whole_file
from replay.mcap.reader import Recording, read_recording
from replay.rerun.meshes import deepest, hand_mesh
from runners.reporting.figures import drawing
from runners.reporting.silhouette import CONTACT, TRUE_POSE, Oblique, Silhouettes, corners_in

_SIZE, _DPI = (9.0, 6.6), 80  # inches, and pixels of one
_PANELS = 0.69  # height of a session's panel in that of the figure
_COLORS = ("#0072b2", "#d55e00", "#009e73")  # of the sessions
_HAND, _PATH, _PAST, _FORECAST = "#999999", "#555555", "#aaaaaa", "#cc79a7"
_IN_VIEW = (0.03, 0.97)  # quantiles of the hypotheses' corners
_MARGIN = 0.06  # metres around what is in view
_FLOOR = 0.1  # metres between lines on the floor
_SURFACE = 500  # points, of which distances are measured
_MOST_PROBES = 60  # of a session; the first are shown
_ON_THE_WAY = (0.4, 0.75, 1.0)  # of the hand's way to where it is deepest, a frame each
_MOVING, _SHOWN, _LAST = 120, 600, 4000  # milliseconds of a frame
_QUICK = 180  # of a probe after the first session has ended
_QUALITY = 62  # of 100


@dataclass(frozen=True, eq=False)
class ShownSession:
    """What is drawn of a recording."""

    title: str
    color: str
    start: SessionStarted
    probes: list[Probe]
    poses: dict[int, FloatArray]  # by step: world_from_object (B, 4, 4), without repeated ones
    errors: dict[int, float]  # by step: of the set, millimetres
    forecasts: dict[int, FloatArray]  # by step of the probe: where it was to meet the object (M, 3)
    hand: trimesh.Trimesh | None

    @classmethod
    def of(cls, recording: Recording, title: str, color: str) -> ShownSession:
        """Raises SettingError for a recording without a true pose or without a probe."""
        start, truth = recording.start, recording.start.world_from_object
        if truth is None or not recording.probes:
            what = "true pose" if truth is None else "probe"
            raise SettingError(f"{recording.path} has no {what}; accepted: a simulated session")
        points = surface_points(start.mesh, _SURFACE, StreamKey(start.seed, 0))
        distance = SurfaceDistance(start.sdf, start.mesh, points)
        poses, errors = {}, {}
        for step in recording.steps[:_MOST_PROBES]:
            found = recording.hypotheses(step)
            kept = found.object_from_world[~found.duplicate]
            if len(kept):
                poses[step] = inverse(kept)
                errors[step] = float(np.sqrt(distance.between(kept, truth[None]).mean()))
        forecasts = {}
        for step in recording.decision_steps[:_MOST_PROBES]:
            met = recording.decision(step).decision.contacts
            forecasts[step + 1] = met[np.isfinite(met).all(axis=1)]
        hand = None if recording.offered is None else hand_mesh(recording.offered.hand)
        probes = list(recording.probes[:_MOST_PROBES])
        return cls(title, color, start, probes, poses, errors, forecasts, hand)

    @property
    def count(self) -> int:
        """Of probes."""
        return len(self.probes)

    @cached_property
    def contacts(self) -> list[FloatArray]:
        """Those of all probes up to each one, (C, 3)."""
        found = [np.zeros((0, 3))]
        for probe in self.probes:
            found.append(np.concatenate([found[-1], probe.contacts]))
        return found[1:]

    def result_after(self, done: int) -> int | None:
        """The last step with hypotheses when so many probes are done."""
        steps = [probe.step for probe in self.probes[:done] if probe.step in self.poses]
        return max(steps, default=None)

    def curve(self, done: int) -> FloatArray:
        """Number of probes and error in mm (N, 2) of each result when so many probes are done."""
        found = [
            (place + 1, self.errors[probe.step])
            for place, probe in enumerate(self.probes[:done])
            if probe.step in self.errors
        ]
        return np.array(found, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class Moment:
    """What a frame shows: after so many probes, and how far the next one has come."""

    done: int
    on_the_way: float  # of the next probe's way to where it is deepest; 0: all are done
    milliseconds: int


def moments(counts: Sequence[int]) -> Iterator[Moment]:
    """The frames for sessions of so many probes."""
    for done in range(max(counts)):
        quick = done >= min(counts)
        if not quick:
            yield from (Moment(done, part, _MOVING) for part in _ON_THE_WAY)
        last = done + 1 == max(counts)
        yield Moment(done + 1, 0.0, _LAST if last else _QUICK if quick else _SHOWN)


class ProbingAnimation:
    """Draws sessions that probe the same object."""

    def __init__(self, sessions: Sequence[ShownSession]) -> None:
        """Raises SettingError if they are of different objects."""
        first = sessions[0].start
        for session in sessions:
            require_choice(f"object of {session.title}", session.start.object, (first.object,))
        self._sessions = sessions
        self._hand = next((s.hand for s in sessions if s.hand is not None), None)
        poses = [pose for s in sessions for found in s.poses.values() for pose in found]
        corners = corners_in(first.mesh, poses or [np.eye(4)])
        truth = corners_in(first.mesh, [_truth(first)])
        known = [s.contacts[-1] for s in sessions]
        in_view = [np.quantile(corners, _IN_VIEW, axis=0), truth, *known]
        aspect = _PANELS * _SIZE[1] / (_SIZE[0] / len(sessions))
        self._frame = Oblique.holding(np.concatenate(in_view), _MARGIN, aspect=aspect)
        self._object = Silhouettes(first.mesh, self._frame)
        self._gripper = None if self._hand is None else Silhouettes(self._hand, self._frame)

    def frames(self) -> Iterator[tuple[Image.Image, int]]:
        """Each frame with the milliseconds for which it is shown."""
        for moment in moments([session.count for session in self._sessions]):
            yield self.frame(moment), moment.milliseconds

    def frame(self, moment: Moment) -> Image.Image:
        """The picture of one moment."""
        canvas = FigureCanvasAgg(self.figure(moment))
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")

    def figure(self, moment: Moment) -> Figure:
        """All sessions at one moment, side by side, and the curves of their errors below."""
        figure = Figure(figsize=_SIZE, dpi=_DPI)
        count = len(self._sessions)
        for column, session in enumerate(self._sessions):
            panel = figure.add_axes((column / count, 0.25, 1.0 / count, _PANELS))
            self._draw(panel, session, moment)
        self._curves(figure.add_axes((0.09, 0.085, 0.62, 0.15)), moment)
        self._legend(figure)
        return figure

    def _draw(self, panel: Axes, session: ShownSession, moment: Moment) -> None:
        frame = self._frame
        frame.set_on(panel)
        workspace = session.start.workspace
        for line in _floor(workspace.bounds[0], workspace.bounds[1]):
            panel.plot(*frame.flat(line).T, color="#e4e4e4", linewidth=0.6, zorder=0.5)
        done = min(moment.done, session.count)
        step = session.result_after(done)
        if step is not None:
            for pose in session.poses[step]:
                self._object.draw(panel, pose, session.color, width=0.8, alpha=0.4)
        truth = _truth(session.start)
        self._object.draw(panel, truth, TRUE_POSE, width=1.6, style="dashed")
        for probe in session.probes[:done]:
            self._path(panel, probe, _PAST, width=0.7)
        if moment.on_the_way and done < session.count:
            self._move(panel, session, done, moment.on_the_way)
        contacts = session.contacts[done - 1] if done else np.zeros((0, 3))
        panel.plot(*frame.flat(contacts).T, **CONTACT, zorder=6.0)
        panel.set_title(_title(session, done, step), fontsize=12.0)

    def _move(self, panel: Axes, session: ShownSession, place: int, part: float) -> None:
        """The hand on its way, and where it was to meet the object."""
        probe, frame = session.probes[place], self._frame
        forecast = session.forecasts.get(probe.step)
        if forecast is not None:
            flat = frame.flat(forecast)
            panel.plot(*flat.T, ".", color=_FORECAST, markersize=5.0, zorder=5.0)
        if len(probe.gripper_path) == 0:
            return
        self._path(panel, probe, _PATH, width=1.6)
        if self._gripper is not None:
            self._gripper.fill(panel, _on_the_way(probe, part), _HAND, alpha=0.75)

    def _path(self, panel: Axes, probe: Probe, color: str, *, width: float) -> None:
        if len(probe.gripper_path):
            way = probe.gripper_path[: deepest(probe.gripper_path) + 1, :3, 3]
            panel.plot(*self._frame.flat(way).T, color=color, linewidth=width, zorder=4.0)

    def _curves(self, panel: Axes, moment: Moment) -> None:
        errors = [error for session in self._sessions for error in session.errors.values()]
        most = max(session.count for session in self._sessions)
        panel.set(xlim=(0.5, most + 0.5), xlabel="probes", ylabel="error in mm")
        if errors:
            panel.set_yscale("log")
            panel.set_ylim(0.8 * min(errors), 1.25 * max(errors))
            panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            panel.yaxis.set_minor_formatter(NullFormatter())
        for session in self._sessions:
            x, y = session.curve(moment.done).T
            panel.plot(x, y, color=session.color, marker="o", markersize=3.0, linewidth=1.5)

    def _legend(self, figure: Figure) -> None:
        handles = [
            Line2D([], [], color=TRUE_POSE, linestyle="--", label="true pose"),
            Line2D([], [], **CONTACT, label="contacts"),
        ]
        if any(session.forecasts for session in self._sessions):
            dots = Line2D([], [], color=_FORECAST, marker=".", linestyle="none")
            dots.set_label("forecast contacts")
            handles.append(dots)
        figure.legend(handles=handles, loc="lower right", bbox_to_anchor=(0.99, 0.06))


def animation(frames: Sequence[Image.Image], milliseconds: Sequence[int]) -> bytes:
    """Frames of one size, each shown for its time, again and again, as a WebP file."""
    stream = io.BytesIO()
    first, *others = (frame.convert("RGB") for frame in frames)
    first.save(
        stream,
        format="webp",
        save_all=True,
        append_images=others,
        duration=list(milliseconds),
        loop=0,
        quality=_QUALITY,
        method=6,
    )
    return stream.getvalue()


def _truth(start: SessionStarted) -> FloatArray:
    assert start.world_from_object is not None
    return start.world_from_object


def _on_the_way(probe: Probe, part: float) -> FloatArray:
    """The hand's pose (4, 4) after a part of its way to where it is deepest."""
    way = probe.gripper_path[: deepest(probe.gripper_path) + 1]
    steps = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)
    gone = np.append(0.0, np.cumsum(steps))
    pose: FloatArray = way[int(np.argmin(np.abs(gone - part * gone[-1])))]
    return pose


def _title(session: ShownSession, done: int, step: int | None) -> str:
    if step is None:
        return f"{session.title}: {done} probes"
    ended = ", ended" if done == session.count else ""
    return f"{session.title}: {done} probes{ended}, error {session.errors[step]:.0f} mm"


def _floor(lower: FloatArray, upper: FloatArray) -> Iterator[FloatArray]:
    """Lines (2, 3) on the floor of a workspace."""
    for axis, other in ((0, 1), (1, 0)):
        first, last = np.ceil(lower[axis] / _FLOOR), np.floor(upper[axis] / _FLOOR)
        for at in np.arange(first, last + 1) * _FLOOR:
            line = np.full((2, 3), lower[2])
            line[:, axis], line[:, other] = at, (lower[other], upper[other])
            yield line


def main() -> int:
    """`python -m runners.reporting.probing_animation OUT.webp TITLE=RECORDING ...`."""
    parser = argparse.ArgumentParser(
        prog="runners.reporting.probing_animation", description=__doc__
    )
    parser.add_argument("out", type=Path, help="a .webp file")
    parser.add_argument("sessions", nargs="+", metavar="TITLE=RECORDING", help="of one object")
    given = parser.parse_args()
    try:
        require_choice("suffix of the animation", given.out.suffix, (".webp",))
        if len(given.sessions) > len(_COLORS):
            count = len(given.sessions)
            raise SettingError(f"{count} sessions are named; accepted: at most {len(_COLORS)}")
        colors = _COLORS[: len(given.sessions)]
        sessions = [_named(*pair) for pair in zip(given.sessions, colors, strict=True)]
        with drawing():
            frames, times = zip(*ProbingAnimation(sessions).frames(), strict=True)
        with whole_file(given.out, "a folder that can be written") as beside:
            beside.write_bytes(animation(frames, times))
        print_written(given.out)
    except (ChselError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


def _named(text: str, color: str) -> ShownSession:
    title, equals, path = text.partition("=")
    if not equals:
        raise SettingError(f"{text!r} has no title; accepted: TITLE=RECORDING")
    return ShownSession.of(read_recording(Path(path)), title, color)


if __name__ == "__main__":
    sys.exit(main())
