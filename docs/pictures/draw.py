"""`python -m docs.pictures.draw NAME OUT [TITLE=]RECORDING ...`: a picture of recordings.

NAME: `stages`, `faults`, `sequence` or `animation`, the functions of this file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import binary_closing, binary_fill_holes, gaussian_filter

from chsel.methods.anchor_sampling import AnchorSampler, most_informative_first
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import EFFORTS, AnchoredSettings
from chsel.methods.anchored.search import Search
from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import SurfaceDistance, surface_points
from chsel.problem.noise import FOREIGN
from chsel.problem.poses import Poses, apply, inverse
from chsel.problem.registration_problem import NullObserver
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.search_space import search_space
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from chsel.problem.surface import signed_distances
from chsel.session.judging import trust_by
from replay.comparing.choices import recorded_method
from replay.mcap.reader import read_recording
from replay.rerun.scene import coarsened, deepest
from runners.reporting.figures import (
    WIDTH,
    drawing,
    new_figure,
    positive_scale,
    styles_of,
)
from runners.sessions.faults import FaultSettings, level_name, probed_mesh

TRUE_POSE, POSES = "#000000", "#0072b2"
CONTACT: Any = {"color": "#e69f00", "marker": "o", "markersize": 6.0, "zorder": 6.0}
CONTACT |= {"markeredgecolor": "#222222", "linestyle": "none"}
_AXES = {  # the directions in the world that a view has to the right and upwards
    "xz": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "yz": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "oblique": np.array([[0.795, -0.607, 0.0], [0.256, 0.336, 0.906]]),
}
_TICKS = (-30, -10, -3, -1, 0, 1, 3, 10, 30)  # millimetres; logarithmic beyond 1
_SIZE, _PANELS = (9.0, 6.6), 0.69  # inches; share of the height that panels have
_COLORS = ("#0072b2", "#d55e00", "#009e73")  # of the sessions
_PARTS = (0.4, 0.75, 1.0)  # of the hand's way to where it is deepest, a frame each
# milliseconds of a frame
_MOVING = 120
_SHOWN = 600
_QUICK = 180
_LAST = 4000


@cache
def _surface(mesh: trimesh.Trimesh) -> FloatArray:
    return surface_points(mesh, 12_000, key=StreamKey(0, 0))


class View:
    """The part of the world that a panel shows: all points (N, 3), and 6 cm around them."""

    def __init__(self, name: str, points: Sequence[FloatArray], *, aspect: float | None = None):
        """aspect: height by width; by default that of the points."""
        self._name = name
        flat = np.concatenate(points) @ _AXES[name].T
        lower = flat.min(axis=0) - 0.06
        upper = flat.max(axis=0) + 0.06
        self.aspect = aspect or float(np.divide(*(upper - lower)[::-1]))
        width = max(upper[0] - lower[0], (upper[1] - lower[1]) / self.aspect)
        self._half = 0.5 * width * np.array([1.0, self.aspect])
        self._middle = (lower + upper) / 2.0

    def flat(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) as they are seen (2, N)."""
        return _AXES[self._name] @ points.T

    def outline(
        self, panel: Axes, mesh: Any, *, poses: Iterable[FloatArray], color: str, fill: bool = False
    ) -> None:
        """A mesh in poses (4, 4): its outline, that of the true pose dashed, or what is behind."""
        points = _surface(mesh)
        side = self._half.max() / 80.0
        low = self._middle - self._half - 3 * side
        high = self._middle + self._half + 3 * side
        edges = [np.arange(low[i], high[i], side) for i in (0, 1)]
        x, y = (some[:-1] + side / 2 for some in edges)
        look: Any = {"colors": color, "linewidths": 0.8, "alpha": 0.4}
        if color == TRUE_POSE:
            look |= {"linewidths": 1.8, "alpha": 1.0, "linestyles": "dashed"}
        for pose in poses:
            hit = np.histogram2d(*self.flat(apply(pose, points)), bins=edges)[0] > 0
            filled = binary_fill_holes(binary_closing(hit, iterations=3))
            covered = gaussian_filter(filled.astype(float), 0.8).T
            if fill:
                panel.contourf(x, y, covered, [0.5, 2.0], colors=[color], alpha=0.75)
            else:
                panel.contour(x, y, covered, [0.5], **look)

    def finish(self, panel: Axes) -> None:
        """Limits and labels of a panel."""
        (left, low) = self._middle - self._half
        (right, high) = self._middle + self._half
        panel.set(xlim=(left, right), ylim=(low, high), aspect="equal")
        panel.set(xlabel=f"{self._name[0]} in m", ylabel=f"{self._name[1]} in m")
        panel.grid(visible=False)
        if self._name == "oblique":
            panel.set_axis_off()


def corners_in(
    mesh: trimesh.Trimesh, poses: Iterable[FloatArray], *, cut: float = 0.0
) -> FloatArray:
    """What spans (2, 3) the mesh's boxes in poses (4, 4), but for a share of their corners."""
    every = np.concatenate([apply(pose, trimesh.bounds.corners(mesh.bounds)) for pose in poses])
    return np.quantile(every, [cut, 1.0 - cut], axis=0)


Cell = tuple[str, str, FloatArray, FloatArray]
"""Title, colour, poses world_from_object (B, 4, 4), contacts (C, 3)."""


def _save_panels(
    out: str, mesh: trimesh.Trimesh, *, truth: FloatArray, rows: list[list[Cell]]
) -> None:
    """A panel for each cell: a set of poses, the true one (4, 4), contacts."""
    cells = [cell for row in rows for cell in row]
    guessed = corners_in(mesh, np.concatenate([poses for _, _, poses, _ in cells]), cut=0.04)
    view = View("xz", [guessed, corners_in(mesh, [truth]), *(known for *_, known in cells)])
    height = ((WIDTH - 1.2) / len(rows[0]) - 0.5) * view.aspect
    with drawing():
        figure = new_figure(1.1 + len(rows) * (height + 0.5))
        panels = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for panel, (title, color, poses, contacts) in zip(panels.flat, cells, strict=True):
            view.outline(panel, mesh, poses=poses, color=color)
            view.outline(panel, mesh, poses=[truth], color=TRUE_POSE)
            panel.plot(*view.flat(contacts), **CONTACT)
            panel.set_title(title)
            view.finish(panel)
            panel.label_outer()
        small_png(as_image(figure, 120), out)


def as_image(figure: Figure, dpi: float) -> Image.Image:
    """A figure as pixels."""
    figure.set_dpi(dpi)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))


def small_png(image: Image.Image, path: str) -> None:
    """Write a picture in few colours."""
    method = Image.Quantize.FASTOCTREE  # keeps colours of few pixels, such as contacts
    few = image.convert("RGB").quantize(256, method=method, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


class _FirstTraces(NullObserver):
    """Keeps the first trace of each stage."""

    def __init__(self) -> None:
        self.of_stage: dict[str, tuple[FloatArray, FloatArray]] = {}

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        self.of_stage.setdefault(stage, (vectors, cost))


def stages(out: str, recording_path: str) -> None:
    """A panel for every stage of the registration at step 4."""
    recording = read_recording(recording_path)
    settings = AnchoredSettings()
    traces = _FirstTraces()
    start = recording.start
    problem = recording.problem(4)
    effort = EFFORTS[settings.size]
    space = search_space(settings.plane, problem.sdf)
    known = most_informative_first(problem.points)
    sampler = AnchorSampler(problem, known, space=space, settings=settings.anchors)
    sampled = sampler.best(effort.samples, effort.kept)
    found = Anchored(settings).register(problem, traces)
    energy = Search(problem, settings, observer=NullObserver()).energy
    stages = {"sampled on contacts": (sampled.matrices, energy.of(sampled))}
    for name, title in (("fit", "fitted"), ("spread", "spread below the limit")):
        vectors, energies = traces.of_stage[name]
        stages[title] = space.poses(vectors).matrices, energies
    stages["chosen"] = found.object_from_world, found.cost
    cells = []
    for title, (poses, energies) in stages.items():
        title = f"{len(poses)} {title}\nmedian energy {np.median(energies):.1f} nats"
        order = np.argsort(energies)[
            :: -(-len(energies) // 30)
        ]  # evenly, so that about 30 are seen
        cells.append((title, POSES, inverse(poses[order]), problem.points.contacts))
    _save_panels(out, start.mesh, truth=start.world_from_object, rows=[cells])


def sequence(out: str, *named: str) -> None:
    """A row for each method, a column for each of the first, the last and two steps between."""
    files = dict(text.split("=", 1) for text in named)
    recordings = {method: read_recording(file) for method, file in files.items()}
    styles = styles_of(list(files))
    common = sorted(set.intersection(*(set(one.steps) for one in recordings.values())))
    rows = []
    for method, recording in recordings.items():
        row = []
        for step in (common[round(place)] for place in np.linspace(0, len(common) - 1, 4)):
            poses = inverse(recording.hypotheses(step).object_from_world[::-1])  # best on top
            title = f"{styles[method].title}, step {step}"
            contacts = recording.problem(step)
            row.append((title, styles[method].color, poses, contacts.points.contacts))
        rows.append(row)
    start = next(iter(recordings.values())).start
    _save_panels(out, start.mesh, truth=start.world_from_object, rows=rows)


def faults(out: str, recording_path: str) -> None:
    """The first hypotheses of a kinematic session with faults, of the method `anchored`.

    Both views of them, and the distances of contacts from the surface.
    """
    recording = read_recording(recording_path)
    start, step = recording.start, recording.steps[0]
    level = build_settings(FaultSettings, start.config["session"].get("faults", {}), where="faults")
    method = recorded_method(recording).build()
    truth = start.world_from_object
    problem, found = recording.problem(step), recording.hypotheses(step)
    true_pose = inverse(truth[None])
    trust = trust_by(method, problem, hypotheses=found)
    held = "in" if method.holds(problem, found, true_pose)[0] else "outside"
    contacts, free = problem.points.known, problem.points.free
    both = Poses.of(np.concatenate([true_pose, found.object_from_world[:1]]))
    off = 1e3 * signed_distances(
        problem.sdf, both, points=contacts
    )  # (2, C), mm, at truth and best
    far = np.abs(off[0]) > 10.0
    probed = probed_mesh(start.mesh, level)
    wrong = free[mesh_sdf(probed, apply(true_pose[0], free))[0] < 0.0]
    poses = inverse(found.object_from_world)
    outlying = CONTACT | {"color": "#d55e00", "marker": "X", "markersize": 9.0}
    inside = CONTACT | {"color": "#cc79a7", "marker": "s", "markersize": 7.0}
    shown = (
        (contacts[~far], CONTACT, "contact"),
        (contacts[far], outlying, "contact over 10 mm off the object"),
        (wrong, inside, "free voxel inside the object"),
    )
    with drawing():
        figure = new_figure(4.5)
        *panels, panel = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
        corners = corners_in(start.mesh, poses, cut=0.05), corners_in(start.mesh, [truth])
        for each, name in zip(panels, ("xz", "yz"), strict=True):
            view = View(name, [*corners, contacts])
            view.outline(each, start.mesh, poses=poses, color=POSES)
            view.outline(each, probed, poses=[truth], color=TRUE_POSE)
            each.plot([], [], color=POSES, label=f"{len(poses)} hypotheses")
            each.plot([], [], color=TRUE_POSE, linestyle="--", label="true outline")
            for points, look, label in shown:
                if len(points):
                    each.plot(*view.flat(points), **look, label=label)
            view.finish(each)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        sigma = 1e3 * trust.noise
        rows = np.arange(len(contacts)) + 1
        panel.axvspan(-sigma, sigma, color="#dddddd")
        for side in (-FOREIGN, FOREIGN):
            panel.axvline(side * sigma, color="#888888", linestyle=":")
        panel.plot(off[0], rows, "o", color="none", markeredgecolor=TRUE_POSE, markersize=10.0)
        panel.plot(off[1], rows, "o", color=POSES, markersize=6.0)
        panel.set_xscale("symlog", linthresh=1.0)
        panel.set(xlim=(-60, 60), yticks=rows, xlabel="distance from the surface in mm")
        panel.set_xticks(_TICKS, [f"{tick}" for tick in _TICKS])
        panel.set_xticks([], minor=True)
        panel.set(
            ylabel="contact",
            title="rings: true pose, dots: best hypothesis\ngrey: noise, dotted: outliers beyond",
        )
        noise = f"estimated noise {sigma:.1f} mm, outliers {100.0 * trust.outliers:.0f} %"
        title = f"{level_name(level)}: {start.object}, {len(contacts)} contacts"
        figure.suptitle(f"{title}\n{noise}; {trust.verdict}; truth {held} the set")
        small_png(as_image(figure, 120), out)


class _Session:
    """What is drawn of a recording; sets of poses and errors (mm) by number of probes."""

    def __init__(self, title: str, file: str, color: str) -> None:
        recording = read_recording(file)
        self.title = title
        self.color = color
        self.start = recording.start
        self.probes = list(recording.probes)
        self.poses = {}
        self.errors = {}
        points = surface_points(self.start.mesh, 500, key=StreamKey(self.start.seed, 0))
        distance = SurfaceDistance(self.start.sdf, self.start.mesh, points=points)
        for done, probe in enumerate(self.probes, 1):
            if probe.step in recording.steps:
                found = recording.hypotheses(probe.step)
                kept = found.object_from_world[~found.duplicate]
                squared = distance.between(kept, self.start.world_from_object[None])
                self.poses[done] = inverse(kept)
                self.errors[done] = np.sqrt(squared.mean())
        self.contacts = np.concatenate([probe.contacts for probe in self.probes])
        self.hand = None if recording.offered is None else coarsened(recording.offered.hand)

    def draw(self, panel: Axes, view: View, *, hand: object, done: int, part: float) -> None:
        """The session after so many probes, and a part of the way of the next one."""
        title = f"{self.title}: {done} probes"
        if results := [number for number in self.poses if number <= done]:
            view.outline(panel, self.start.mesh, poses=self.poses[results[-1]], color=self.color)
            title += f", error {self.errors[results[-1]]:.0f} mm"
        view.outline(panel, self.start.mesh, poses=[self.start.world_from_object], color=TRUE_POSE)
        for number, probe in enumerate(self.probes[: done + (part > 0.0)]):
            path = probe.gripper_path[: deepest(probe.gripper_path) + 1]
            look = ("#aaaaaa", 0.7) if number < done else ("#555555", 1.6)
            way = view.flat(path[:, :3, 3])
            panel.plot(*way, color=look[0], linewidth=look[1], zorder=4.0)
            if number == done and hand is not None:
                place = path[round(part * (len(path) - 1))]
                view.outline(panel, hand, poses=[place], color="#999999", fill=True)
        known = sum(len(probe.contacts) for probe in self.probes[:done])
        panel.plot(*view.flat(self.contacts[:known]), **CONTACT)
        panel.set_title(title)
        view.finish(panel)


def _curves(panel: Axes, sessions: Sequence[_Session], *, done: int) -> None:
    every = [error for session in sessions for error in session.errors.values()]
    most = max(len(session.probes) for session in sessions)
    panel.set(xlim=(0.5, most + 0.5), xlabel="probes", ylabel="error in mm")
    positive_scale(panel, pd.Series(every))
    panel.set_ylim(0.8 * min(every), 1.25 * max(every))
    for session in sessions:
        errors = {number: error for number, error in session.errors.items() if number <= done}
        panel.plot(list(errors), errors.values(), color=session.color, marker="o", markersize=3)
    panel.plot([], [], color=TRUE_POSE, linestyle="--", label="true pose")
    panel.plot([], [], **CONTACT, label="contacts")
    panel.legend(loc="center left", bbox_to_anchor=(1.03, 0.4))


def webp(frames: Sequence[Image.Image], milliseconds: Sequence[int], *, path: str) -> None:
    """Write frames of one size, each shown for its time, again and again."""
    first, *others = (frame.convert("RGB") for frame in frames)
    looks = {"duration": list(milliseconds), "loop": 0, "quality": 62, "method": 6}
    first.save(path, format="webp", save_all=True, append_images=others, **looks)


def animation(out: str, *named: str) -> None:
    """Up to three sessions of one object; after the first has ended, the others go on quickly."""
    titles = [text.split("=", 1) for text in named]
    sessions = [_Session(*pair, color) for pair, color in zip(titles, _COLORS, strict=False)]
    start = sessions[0].start
    counts = [len(session.probes) for session in sessions]
    poses = np.concatenate([found for one in sessions for found in one.poses.values()])
    corners = (
        corners_in(start.mesh, poses, cut=0.03),
        corners_in(start.mesh, [start.world_from_object]),
    )
    width = 1.0 / len(sessions)
    known = [session.contacts for session in sessions]
    view = View("oblique", [*corners, *known], aspect=_PANELS * _SIZE[1] / (_SIZE[0] * width))
    hand = next((session.hand for session in sessions if session.hand is not None), None)
    moments = []
    for done in range(max(counts)):
        parts = _PARTS if done < min(counts) else ()
        shown = _LAST if done + 1 == max(counts) else _SHOWN if parts else _QUICK
        moments += [*((done, part, _MOVING) for part in parts), (done + 1, 0.0, shown)]
    frames = []
    with drawing():
        for done, part, _ in moments:
            figure = Figure(figsize=_SIZE)
            FigureCanvasAgg(figure)
            for n, session in enumerate(sessions):
                panel = figure.add_axes((n * width, 0.25, width, _PANELS))
                session.draw(panel, view, hand=hand, done=min(done, counts[n]), part=part)
            _curves(figure.add_axes((0.09, 0.085, 0.62, 0.15)), sessions, done=done)
            frames.append(as_image(figure, 80))
    webp(frames, [shown for *_, shown in moments], path=out)


PICTURES = {picture.__name__: picture for picture in (stages, faults, sequence, animation)}

if __name__ == "__main__":
    PICTURES[sys.argv[1]](*sys.argv[2:])
