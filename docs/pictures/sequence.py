"""`python -m docs.pictures.sequence OUT.png METHOD=RECORDING ...`: hypotheses over the probes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from docs.pictures.outlines import CONTACT, TRUE_POSE, Frame, Outlines, corners_in, save_figure
from replay.mcap.reader import read_recording
from runners.reporting.figures import WIDTH, drawing, new_figure, styles_of

_STEPS = 4
_APPROACH = 0.05  # metres of the gripper's way that are drawn before a contact
_MOVED = 0.005  # metres, less is shaking


def way_to(contact: FloatArray, path: FloatArray) -> FloatArray:
    """Start and end (2, 3) of the last of the gripper's way (P, 4, 4) to a contact."""
    places = path[:, :3, 3] if len(path) else contact[None]
    touching = int(np.argmin(np.linalg.norm(places - contact, axis=1)))
    ways = places[touching] - places[:touching]
    lengths = np.linalg.norm(ways, axis=1)
    moved = np.flatnonzero(lengths > _MOVED)
    back = _APPROACH * ways[moved[-1]] / lengths[moved[-1]] if len(moved) else 0.0
    return np.stack([contact - back, contact])


def main(out: str, *named: str) -> None:
    """A row for each method, a column for each of the first, the last and two steps between."""
    files = dict(text.split("=", 1) for text in named)
    recordings = {method: read_recording(Path(file)) for method, file in files.items()}
    first, styles = next(iter(recordings.values())), styles_of(list(files))
    common = [step for step in first.steps if all(step in r.steps for r in recordings.values())]
    steps = [common[round(place)] for place in np.linspace(0, len(common) - 1, _STEPS)]
    mesh, truth = first.start.mesh, first.start.world_from_object
    poses = {
        (method, step): inverse(recording.hypotheses(step).object_from_world)
        for method, recording in recordings.items()
        for step in steps
    }
    guessed = corners_in(mesh, np.concatenate(list(poses.values())))
    contacts = [probe.contacts for probe in first.probes if probe.step <= steps[-1]]
    in_view = [*contacts, np.quantile(guessed, [0.05, 0.95], axis=0), corners_in(mesh, [truth])]
    frame = Frame.around("xz", in_view, 0.06)
    outlines = Outlines(mesh, frame)
    height = ((WIDTH - 1.2) / _STEPS - 0.5) * frame.aspect
    with drawing():
        figure = new_figure(1.1 + len(files) * (height + 0.3))
        panels = figure.subplots(len(files), _STEPS, squeeze=False)
        for (row, column), panel in np.ndenumerate(panels):
            method, step = list(files)[row], steps[column]
            for pose in poses[method, step][::-1]:  # the best on top
                outlines.draw(panel, pose, styles[method].color, linewidths=0.9, alpha=0.45)
            outlines.draw(panel, truth, TRUE_POSE, linewidths=1.8, linestyles="dashed")
            for probe in recordings[method].probes:
                for contact in probe.contacts if probe.step <= step else ():
                    way = frame.flat(way_to(contact, probe.gripper_path))
                    panel.plot(*way.T, color=CONTACT["color"], linewidth=1.8, zorder=5.0)
                    panel.plot(*way[1], **CONTACT)
            frame.set_on(panel)
            panel.set_title(f"{styles[method].title}, step {step}")
            panel.label_outer()
        save_figure(figure, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
