"""`python -m runners.reporting.anchored_stages`: what the stages of method=anchored leave over."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from chsel.errors import ChselError
from chsel.methods.anchored.anchor_sampling import anchored_poses, most_informative_first
from chsel.methods.anchored.anchored import Anchored, Search
from chsel.methods.anchored.anchored_settings import EFFORTS, AnchoredSettings
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, inverse
from chsel.problem.registration_problem import NullObserver, RegistrationProblem
from chsel.problem.search_space import search_space
from replay.console import print_error
from replay.mcap.reader import Recording, read_recording
from runners.reporting.panels import drawn, new_figure
from runners.reporting.silhouette import VIEWS, Frame, Silhouettes
from runners.reporting.small_picture import small_png

_OUTLINES = 30  # of each stage, evenly from the lowest energy to the highest
_COLOR = "#0072b2"
_CONTACTS: Any = {
    "color": "#e69f00",
    "marker": "o",
    "markersize": 6.0,
    "markeredgecolor": "#222222",
    "linestyle": "none",
}
_MARGIN = 0.05  # metres around what is in view
_IN_VIEW = (0.02, 0.98)  # quantiles of the sampled poses' corners
_LEAST = 0.01  # millimetres: below it a median energy is not written as a number


@dataclass(frozen=True)
class Stage:
    """Poses object_from_world (B, 4, 4) and energies (B,) in metres, the lowest first."""

    title: str
    poses: FloatArray
    energies: FloatArray


class _Traces(NullObserver):
    """Keeps what each stage of a registration told last."""

    def __init__(self) -> None:
        self.told: dict[str, tuple[FloatArray, FloatArray]] = {}

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Keep it."""
        self.told[stage] = vectors, cost


def stages_of(problem: RegistrationProblem, settings: AnchoredSettings) -> list[Stage]:
    """Sampled, fitted, spread and chosen poses of one registration."""
    effort = settings.effort or EFFORTS[settings.size]
    space = search_space(settings.plane, problem.sdf)
    known, anchors = most_informative_first(problem.points), settings.anchors
    sampled = anchored_poses(
        problem, known, space, anchors, samples=effort.samples, most=effort.kept
    )
    energy = Search(problem, settings, NullObserver()).energy
    traces = _Traces()
    found = Anchored(settings).register(problem, traces)
    stages = [_sorted("sampled on contacts", sampled.matrices, energy.of(sampled))]
    for name, title in (("fit", "fitted"), ("spread", "spread below the limit")):
        vectors, energies = traces.told[name]
        stages.append(_sorted(title, space.poses(vectors).matrices, energies))
    return [*stages, _sorted("chosen", found.object_from_world, found.cost)]


def _sorted(title: str, poses: FloatArray, energies: FloatArray) -> Stage:
    order = np.argsort(energies, kind="stable")
    return Stage(title, poses[order], energies[order])


def picture_of_stages(
    recording: Recording, step: int, settings: AnchoredSettings, view: str
) -> bytes:
    """A PNG file: a panel for every stage of the registration at one step of a recording."""
    stages = stages_of(recording.problem(step), settings)
    probes = [probe.contacts for probe in recording.probes if probe.step <= step]
    contacts = np.concatenate([np.zeros((0, 3)), *probes])
    return small_png(drawn(lambda: _figure(recording, stages, contacts, VIEWS[view])))


def _figure(
    recording: Recording, stages: list[Stage], contacts: FloatArray, axes: tuple[int, int]
) -> Figure:
    mesh, truth = recording.start.mesh, recording.start.world_from_object
    corners = np.asarray(mesh.bounding_box.vertices, dtype=np.float64)
    places = np.concatenate([apply(pose, corners) for pose in inverse(stages[0].poses)])
    shown = np.concatenate([np.quantile(places, _IN_VIEW, axis=0), contacts])[:, list(axes)]
    frame = Frame(axes, shown.min(axis=0) - _MARGIN, shown.max(axis=0) + _MARGIN)
    silhouettes = Silhouettes(mesh, frame)
    width, height = frame.upper - frame.lower
    figure = new_figure(float(np.clip(2.75 * height / width, 1.5, 5.0)) + 1.3)
    for column, stage in enumerate(stages):
        panel = figure.add_subplot(1, len(stages), column + 1)
        count = min(_OUTLINES, len(stage.poses))
        evenly = np.arange(count) * len(stage.poses) // count
        for pose in inverse(stage.poses[evenly]):
            silhouettes.draw(panel, pose, _COLOR, width=0.8, alpha=0.45)
        if truth is not None:
            silhouettes.draw(panel, truth, "#000000", width=2.0, style="dashed")
        panel.plot(*contacts[:, list(axes)].T, **_CONTACTS, zorder=6.0)
        _label(panel, stage, frame, first=column == 0)
    handles = [
        Line2D([], [], color=_COLOR, label=f"poses: at most {_OUTLINES} a panel"),
        Line2D([], [], **_CONTACTS, label="contacts"),
    ]
    if truth is not None:
        handles.append(Line2D([], [], color="#000000", linestyle="--", label="true pose"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _label(panel: Axes, stage: Stage, frame: Frame, *, first: bool) -> None:
    median = 1e3 * float(np.median(stage.energies))
    energy = f"{median:.2g} mm" if median >= _LEAST else f"below {_LEAST:g} mm"
    panel.set_title(f"{len(stage.poses)} {stage.title}\nmedian energy {energy}")
    panel.set_xlim(frame.lower[0], frame.upper[0])
    panel.set_ylim(frame.lower[1], frame.upper[1])
    panel.set_aspect("equal")
    panel.grid(visible=False)
    panel.set_xlabel(f"{'xyz'[frame.axes[0]]} in m")
    panel.tick_params(labelleft=first)
    if first:
        panel.set_ylabel(f"{'xyz'[frame.axes[1]]} in m")


def main() -> int:
    """`python -m runners.reporting.anchored_stages RECORDING OUT.png`."""
    parser = argparse.ArgumentParser(prog="runners.reporting.anchored_stages", description=__doc__)
    parser.add_argument("recording", type=Path, help="of any method, whose problem is taken")
    parser.add_argument("png", type=Path)
    parser.add_argument("--step", type=int, help="by default the first that has a problem")
    parser.add_argument("--size", choices=tuple(EFFORTS), default="adaptive")
    parser.add_argument("--view", choices=tuple(VIEWS), default="xz")
    given = parser.parse_args()
    try:
        recording = read_recording(given.recording)
        (step,) = recording.checked_steps(None if given.step is None else [given.step])[:1]
        settings = AnchoredSettings(size=given.size)
        picture = picture_of_stages(recording, step, settings, given.view)
        given.png.write_bytes(picture)
    except (ChselError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
