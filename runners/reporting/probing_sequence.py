"""Hypotheses of some methods at some steps of one trial, as outlines of the mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from replay.events import Probe
from replay.mcap.reader import Recording, read_recording
from runners.reporting.figures import WIDTH, NotDrawn, Picture, new_figure
from runners.reporting.section import Section, Styles, Subject, drawn
from runners.reporting.shown_trial import shown_trial
from runners.reporting.silhouette import (
    CONTACT,
    TRUE_POSE,
    Frame,
    Silhouettes,
    corners_in,
    point_table,
    pose_table,
)

STEPS = 4
_METHODS = ("chsel", "medial_constraint", "icp")
_VIEWS = {
    "xz": "from the side, with the probing direction x to the right",
    "xy": "from above, with the probing direction x to the right",
    "yz": "along the probing direction x",
}
_CONTACT = CONTACT | {"markersize": 5.0, "linestyle": "-"}
_MARGIN = 0.06  # metres around the true pose and the contacts
_IN_VIEW = (0.05, 0.95)  # quantiles of the hypotheses' corners
_APPROACH = 0.05  # metres of the gripper's way that are drawn before a contact
_MOVED = 0.005  # metres, less is shaking


def probing_sequence(subject: Subject) -> Section | None:
    """Of the shown trial; None where none is recorded, and none was asked for."""
    title, evaluation, sequence = "A probing sequence", subject.evaluation, subject.sequence
    try:
        trial, why = shown_trial(subject)
    except NotDrawn as reason:
        return Section("sequence", title, "", missing=str(reason)) if subject.asks else None
    asked = sequence.methods or _METHODS
    paths = {m: evaluation.recording(trial, m) for m in asked}
    if sequence.methods is None and not any(paths.values()):
        paths = {m: evaluation.recording(trial, m) for m in subject.styles}
    found = {method: path for method, path in paths.items() if path is not None}
    text = (
        f"Hypotheses as outlines of the mesh, seen {_VIEWS[sequence.view]}; the true pose is "
        "the broken line, contacts so far are orange, with the gripper's way to them. The trial is "
        f"{trial[0]}, seed {trial[1]}"
    )
    text += f", {why}." if why else "."
    if len(found) < len(paths):
        text += f" Not recorded: {', '.join(m for m in paths if m not in found)}."

    def draw() -> Picture:
        if not found:
            raise NotDrawn(f"there is no recording of {', '.join(asked)} in this trial")
        return picture_of_sequence(found, subject.styles, steps=sequence.steps, view=sequence.view)

    return Section("sequence", title, text, *drawn(draw))


def picture_of_sequence(
    paths: Mapping[str, Path], styles: Styles, *, steps: Sequence[int] | None, view: str
) -> Picture:
    """The picture of the recordings of one trial by method; NotDrawn where none has a result.

    steps: None for the first and last that all methods have, and those evenly between.
    """
    try:
        recordings = {method: read_recording(path) for method, path in paths.items()}
        return _picture(recordings, styles, shown_steps(list(recordings.values()), steps), view)
    except ChselError as error:
        raise NotDrawn(str(error)) from None


def shown_steps(recordings: Sequence[Recording], steps: Sequence[int] | None) -> list[int]:
    """The steps to show: those asked for, else up to four, that all recordings have a result of."""
    common = [
        step
        for step in (recordings[0].steps if recordings else ())
        if all(step in other.steps and other.has_result(step) for other in recordings)
    ]
    if not common:
        raise NotDrawn("no step has a result of every method shown")
    if steps is None:
        places = np.linspace(0, len(common) - 1, min(STEPS, len(common)))
        return [common[round(place)] for place in places.tolist()]
    missing = [step for step in steps if step not in common]
    if missing:
        raise NotDrawn(
            f"step {missing[0]} has no result of every method shown; accepted: "
            f"{', '.join(map(str, common))}"
        )
    return list(steps)


def _picture(
    recordings: Mapping[str, Recording], styles: Styles, steps: Sequence[int], view: str
) -> Picture:
    first = next(iter(recordings.values()))
    truth = [] if first.start.world_from_object is None else [first.start.world_from_object]
    poses = {
        (method, step): inverse(recording.hypotheses(step).object_from_world)
        for method, recording in recordings.items()
        for step in steps
    }
    guessed = corners_in(first.start.mesh, np.concatenate(list(poses.values())))
    contacts = [probe.contacts for probe in first.probes if probe.step <= max(steps)]
    in_view = [*contacts, np.quantile(guessed, _IN_VIEW, axis=0)]
    in_view += [corners_in(first.start.mesh, truth)] if truth else []
    frame = Frame.around(view, in_view, _MARGIN)
    silhouettes = Silhouettes(first.start.mesh, frame)
    panel_width = (WIDTH - 1.2) / max(len(steps), 3) - 0.5
    panel_height = float(np.clip(panel_width * frame.aspect, 1.5, 6.0))
    figure = new_figure(1.1 + len(recordings) * (panel_height + 0.3))
    panels = figure.subplots(len(recordings), len(steps), squeeze=False)
    data = [pose_table(np.array(truth).reshape(-1, 4, 4), kind="true pose")]
    for (row, column), panel in np.ndenumerate(panels):
        method, step = list(recordings)[row], steps[column]
        for pose in poses[method, step][::-1]:  # the best on top
            silhouettes.draw(panel, pose, styles[method].color, width=0.9, alpha=0.45)
        for pose in truth:
            silhouettes.draw(panel, pose, TRUE_POSE, width=1.8, style="dashed")
        probes = [probe for probe in recordings[method].probes if probe.step <= step]
        _draw_contacts(panel, probes, frame)
        frame.set_on(panel, left=column == 0, bottom=row == len(recordings) - 1)
        panel.tick_params(labelsize=9)
        if row == 0:
            panel.set_title(f"step {step}")
        if column == 0:
            panel.set_ylabel(f"{styles[method].title}\n{panel.get_ylabel()}")
        about = {"kind": "hypothesis", "method": method, "step": step}
        data.append(pose_table(poses[method, step], **about))
    for probe in first.probes:
        if probe.step <= max(steps):
            data.append(point_table(probe.contacts, kind="contact", step=probe.step))
    handles = [Line2D([], [], color="#888888", linewidth=1.2, label="hypotheses")]
    if truth:
        handles.append(Line2D([], [], color=TRUE_POSE, linestyle="--", label="true pose"))
    handles.append(Line2D([], [], **_CONTACT, label="contact, and the way to it"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    alt = (
        f"Outlines of {first.start.object} in the poses that "
        f"{', '.join(styles[method].title for method in recordings)} hold for likely at steps "
        f"{', '.join(map(str, steps))}, around the true pose."
    )
    return Picture("sequence", alt, figure, pd.concat(data))


def _draw_contacts(axes: Axes, probes: Sequence[Probe], frame: Frame) -> None:
    """Contacts, each with the last of the way of the gripper to it."""
    for probe in probes:
        for contact in probe.contacts:
            before = contact - _APPROACH * _direction(probe.gripper_path, contact)
            way = frame.flat(np.stack([before, contact]))
            axes.plot(*way.T, color=_CONTACT["color"], linewidth=1.8, zorder=5.0)
            axes.plot(*way[1], **_CONTACT, zorder=6.0)


def _direction(path: FloatArray, contact: FloatArray) -> FloatArray:
    """Unit vector (3,) of the gripper's last way (P, 4, 4) to a contact, zero where unknown."""
    places = path[:, :3, 3]
    if len(places) == 0:
        return np.zeros(3)
    touching = int(np.argmin(((places - contact) ** 2).sum(axis=1)))
    ways = places[touching] - places[:touching]
    lengths = np.sqrt((ways**2).sum(axis=1))
    moved = np.flatnonzero(lengths > _MOVED)
    return ways[moved[-1]] / lengths[moved[-1]] if len(moved) else np.zeros(3)
