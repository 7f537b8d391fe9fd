"""`python -m runners.reporting.anchored_stages`: what the stages of method=anchored leave over."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from chsel.errors import ChselError, require_choice
from chsel.methods.anchor_sampling import AnchorSampler, most_informative_first
from chsel.methods.anchored.anchored import Anchored, Search
from chsel.methods.anchored.anchored_settings import EFFORTS, AnchoredSettings
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import NullObserver, RegistrationProblem
from chsel.problem.search_space import search_space
from replay.console import print_error, print_written
from replay.mcap.reader import Recording, read_recording
from runners.reporting.figures import FORMATS, Picture, drawing, new_figure, write_picture
from runners.reporting.silhouette import (
    CONTACT,
    TRUE_POSE,
    VIEWS,
    Frame,
    Silhouettes,
    corners_in,
    point_table,
    pose_table,
)

_OUTLINES = 30  # of each stage, evenly from the lowest energy to the highest
_COLOR = "#0072b2"
_MARGIN = 0.05  # metres around what is in view
_IN_VIEW = (0.02, 0.98)  # quantiles of the sampled poses' corners


@dataclass(frozen=True)
class Stage:
    """Poses object_from_world (B, 4, 4) and energies (B,) in nats, the lowest first."""

    title: str
    poses: FloatArray
    energies: FloatArray


class _FirstTraces(NullObserver):
    """Keeps the first trace of each stage of a registration."""

    def __init__(self) -> None:
        self.of_stage: dict[str, tuple[FloatArray, FloatArray]] = {}

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Keep it."""
        self.of_stage.setdefault(stage, (vectors, cost))


def stages_of(problem: RegistrationProblem, settings: AnchoredSettings) -> list[Stage]:
    """Sampled, fitted, spread and chosen poses of one registration."""
    effort = settings.effort or EFFORTS[settings.size]
    space = search_space(settings.plane, problem.sdf)
    known, anchors = most_informative_first(problem.points), settings.anchors
    sampled = AnchorSampler(problem, known, space, anchors).best(effort.samples, effort.kept)
    energy = Search(problem, settings, NullObserver()).energy
    traces = _FirstTraces()
    found = Anchored(settings).register(problem, traces)
    stages = [_sorted("sampled on contacts", sampled.matrices, energy.of(sampled))]
    for name, title in (("fit", "fitted"), ("spread", "spread below the limit")):
        vectors, energies = traces.of_stage[name]
        stages.append(_sorted(title, space.poses(vectors).matrices, energies))
    return [*stages, _sorted("chosen", found.object_from_world, found.cost)]


def _sorted(title: str, poses: FloatArray, energies: FloatArray) -> Stage:
    order = np.argsort(energies, kind="stable")
    return Stage(title, poses[order], energies[order])


def picture_of_stages(
    recording: Recording, step: int, settings: AnchoredSettings, *, view: str, name: str
) -> Picture:
    """A panel for every stage of the registration at one step of a recording."""
    start, stages = recording.start, stages_of(recording.problem(step), settings)
    probes = [probe.contacts for probe in recording.probes if probe.step <= step]
    contacts = np.concatenate([np.zeros((0, 3)), *probes])
    places = corners_in(start.mesh, inverse(stages[0].poses))
    frame = Frame.around(view, [np.quantile(places, _IN_VIEW, axis=0), contacts], _MARGIN)
    silhouettes, truth = Silhouettes(start.mesh, frame), start.world_from_object
    figure = new_figure(float(np.clip(2.75 * frame.aspect, 1.5, 5.0)) + 1.3)
    data = [point_table(contacts, kind="contact")]
    for column, stage in enumerate(stages):
        panel = figure.add_subplot(1, len(stages), column + 1)
        count = min(_OUTLINES, len(stage.poses))
        evenly = np.arange(count) * len(stage.poses) // count
        poses = inverse(stage.poses[evenly])
        for pose in poses:
            silhouettes.draw(panel, pose, _COLOR, width=0.8, alpha=0.45)
        if truth is not None:
            silhouettes.draw(panel, truth, TRUE_POSE, width=2.0, style="dashed")
        panel.plot(*frame.flat(contacts).T, **CONTACT, zorder=6.0)
        median = float(np.median(stage.energies))
        panel.set_title(f"{len(stage.poses)} {stage.title}\nmedian energy {median:.1f} nats")
        frame.set_on(panel, left=column == 0)
        panel.tick_params(labelleft=column == 0)
        energies = stage.energies[evenly]
        data.append(pose_table(poses, kind=stage.title, energy_nats=energies))
    handles = [
        Line2D([], [], color=_COLOR, label=f"poses: at most {_OUTLINES} a panel"),
        Line2D([], [], **CONTACT, label="contacts"),
    ]
    if truth is not None:
        handles.append(Line2D([], [], color=TRUE_POSE, linestyle="--", label="true pose"))
        data.append(pose_table(truth[None], kind="true pose"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    alt = f"Outlines of {start.object} in the poses of each stage of the search."
    return Picture(name, alt, figure, pd.concat(data))


def main() -> int:
    """`python -m runners.reporting.anchored_stages RECORDING OUT.png`; or OUT.svg, OUT.pdf."""
    parser = argparse.ArgumentParser(prog="runners.reporting.anchored_stages", description=__doc__)
    parser.add_argument("recording", type=Path, help="of any method, whose problem is taken")
    parser.add_argument("out", type=Path, help="a .png, .svg or .pdf file; data: a .csv beside it")
    parser.add_argument("--step", type=int, help="by default the first that has a problem")
    parser.add_argument("--size", choices=tuple(EFFORTS), default="adaptive")
    parser.add_argument("--view", choices=tuple(VIEWS), default="xz")
    given = parser.parse_args()
    folder, name, kind = given.out.parent, given.out.stem, given.out.suffix[1:]
    try:
        require_choice("suffix of the picture", kind, FORMATS)
        recording = read_recording(given.recording)
        (step,) = recording.checked_steps(None if given.step is None else [given.step])[:1]
        settings = AnchoredSettings(size=given.size)
        with drawing():
            picture = picture_of_stages(recording, step, settings, view=given.view, name=name)
            print_written(*write_picture(picture, folder, kind, small=True))
    except (ChselError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
