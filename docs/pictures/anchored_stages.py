"""`python -m docs.pictures.anchored_stages RECORDING OUT.png`: poses after each stage."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from chsel.methods.anchor_sampling import AnchorSampler, most_informative_first
from chsel.methods.anchored.anchored import EFFORTS, Anchored, AnchoredSettings, Search
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import NullObserver, RegistrationProblem
from chsel.problem.search_space import search_space
from docs.pictures.outlines import (
    CONTACT,
    POSES,
    TRUE_POSE,
    Frame,
    Outlines,
    corners_in,
    save_figure,
)
from replay.mcap.reader import read_recording
from runners.reporting.figures import drawing, new_figure

_STEP = 4
_OUTLINES = 30  # of each stage, evenly from the lowest energy to the highest


class _FirstTraces(NullObserver):
    """Keeps the first trace of each stage."""

    def __init__(self) -> None:
        self.of_stage: dict[str, tuple[FloatArray, FloatArray]] = {}

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        self.of_stage.setdefault(stage, (vectors, cost))


def stages_of(problem: RegistrationProblem) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Poses object_from_world (B, 4, 4) and energies (B,), nats, by stage."""
    settings = AnchoredSettings()
    effort, space = EFFORTS[settings.size], search_space(settings.plane, problem.sdf)
    known = most_informative_first(problem.points)
    sampler = AnchorSampler(problem, known, space, settings.anchors)
    sampled = sampler.best(effort.samples, effort.kept)
    traces = _FirstTraces()
    found = Anchored(settings).register(problem, traces)
    energy = Search(problem, settings, NullObserver()).energy
    stages = {"sampled on contacts": (sampled.matrices, energy.of(sampled))}
    for name, title in (("fit", "fitted"), ("spread", "spread below the limit")):
        vectors, energies = traces.of_stage[name]
        stages[title] = space.poses(vectors).matrices, energies
    return {**stages, "chosen": (found.object_from_world, found.cost)}


def main(recording_path: str, out: str) -> None:
    """A panel for every stage of the registration."""
    recording = read_recording(Path(recording_path))
    start, stages = recording.start, stages_of(recording.problem(_STEP))
    contacts = np.concatenate([p.contacts for p in recording.probes if p.step <= _STEP])
    places = corners_in(start.mesh, inverse(stages["sampled on contacts"][0]))
    frame = Frame.around("xz", [np.quantile(places, [0.02, 0.98], axis=0), contacts], 0.05)
    outlines = Outlines(start.mesh, frame)
    with drawing():
        figure = new_figure(2.75 * frame.aspect + 1.0)
        for column, (title, (poses, energies)) in enumerate(stages.items()):
            panel = figure.add_subplot(1, len(stages), column + 1)
            order = np.argsort(energies)[:: -(-len(energies) // _OUTLINES)]
            for pose in inverse(poses[order]):
                outlines.draw(panel, pose, POSES, linewidths=0.8, alpha=0.45)
            truth = start.world_from_object
            outlines.draw(panel, truth, TRUE_POSE, linewidths=2.0, linestyles="dashed")
            panel.plot(*frame.flat(contacts).T, **CONTACT)
            panel.set_title(f"{len(poses)} {title}\nmedian energy {np.median(energies):.1f} nats")
            frame.set_on(panel)
            panel.label_outer()
        save_figure(figure, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
