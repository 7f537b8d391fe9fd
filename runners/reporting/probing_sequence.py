"""Hypotheses of some methods at some steps of one trial, as outlines of the mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, inverse
from replay.events import Probe
from replay.mcap.reader import Recording, read_recording
from runners.reporting.method_style import MethodStyle
from runners.reporting.panels import WIDTH, drawn, new_figure
from runners.reporting.section import NotDrawn, Picture
from runners.reporting.silhouette import VIEWS, Frame, Silhouettes

STEPS = 4
CONTACT = "#e69f00"
_MARGIN = 0.06  # metres around the true pose and the contacts
_APPROACH = 0.05  # metres of the gripper's way that are drawn before a contact
_MOVED = 0.005  # metres, less is shaking
Styles = Mapping[str, MethodStyle]


def picture_of_sequence(
    recordings: Mapping[str, Path],
    styles: Styles,
    name: str,
    *,
    steps: Sequence[int] | None,
    view: str,
) -> Picture:
    """The picture of the recordings of one trial by method; NotDrawn where none has a result.

    steps: None for the first and last that all methods have, and those evenly between.
    """
    opened: dict[str, Recording] = {}
    for method, path in recordings.items():
        try:
            opened[method] = read_recording(path)
        except ChselError as error:
            raise NotDrawn(str(error)) from None
    shown = shown_steps(list(opened.values()), steps)
    truth = next(iter(opened.values())).start
    alt = (
        f"Outlines of {truth.object} in the poses that {', '.join(styles[m].title for m in opened)}"
        f" hold for likely at steps {', '.join(map(str, shown))}, around the true pose."
    )
    try:
        return Picture(name, alt, drawn(lambda: _figure(opened, styles, shown, view)))
    except ChselError as error:  # of a recording that is damaged further on
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


def _figure(
    recordings: Mapping[str, Recording], styles: Styles, steps: Sequence[int], view: str
) -> Figure:
    start = next(iter(recordings.values())).start
    frame = _frame(recordings, steps, view)
    silhouettes = Silhouettes(start.mesh, frame)
    width, height = frame.upper - frame.lower
    panel_width = (WIDTH - 1.2) / max(len(steps), 3) - 0.5
    panel_height = float(np.clip(panel_width * height / width, 1.5, 6.0))
    figure = new_figure(1.1 + len(recordings) * (panel_height + 0.3))
    for row, (method, recording) in enumerate(recordings.items()):
        for column, step in enumerate(steps):
            place = row * len(steps) + column + 1
            axes = figure.add_subplot(len(recordings), len(steps), place)
            poses = inverse(recording.hypotheses(step).object_from_world)
            for pose in poses[::-1]:  # the best on top
                silhouettes.draw(axes, pose, styles[method].color, width=0.9, alpha=0.45)
            if start.world_from_object is not None:
                silhouettes.draw(
                    axes, start.world_from_object, "#000000", width=1.8, style="dashed"
                )
            _draw_contacts(axes, recording.probes, step, frame)
            _set_frame(axes, frame)
            if row == 0:
                axes.set_title(f"step {step}")
            if column == 0:
                axes.set_ylabel(f"{styles[method].title}\n{'xyz'[frame.axes[1]]} in m")
            if row == len(recordings) - 1:
                axes.set_xlabel(f"{'xyz'[frame.axes[0]]} in m")
    _legend(figure, start.world_from_object is not None)
    return figure


def _frame(recordings: Mapping[str, Recording], steps: Sequence[int], view: str) -> Frame:
    """What holds the true pose, the contacts, and nine of ten of the hypotheses' points."""
    first = next(iter(recordings.values()))
    axes = VIEWS[view]
    corners = np.asarray(first.start.mesh.bounding_box.vertices, dtype=np.float64)
    parts = [probe.contacts for probe in first.probes if probe.step <= max(steps)]
    if first.start.world_from_object is not None:
        parts.append(apply(first.start.world_from_object, corners))
    places = [
        apply(pose, corners)
        for recording in recordings.values()
        for step in steps
        for pose in inverse(recording.hypotheses(step).object_from_world)
    ]
    guessed = np.concatenate(places)
    parts.append(np.quantile(guessed, (0.05, 0.95), axis=0))
    flat = np.concatenate(parts)[:, list(axes)]
    return Frame(axes, flat.min(axis=0) - _MARGIN, flat.max(axis=0) + _MARGIN)


def _draw_contacts(axes: Axes, probes: Sequence[Probe], step: int, frame: Frame) -> None:
    """Contacts so far, each with the last of the way of the gripper to it."""
    right, up = frame.axes
    for probe in probes:
        if probe.step > step:
            continue
        for contact in probe.contacts:
            before = contact - _APPROACH * _direction(probe.gripper_path, contact)
            ends = ([before[right], contact[right]], [before[up], contact[up]])
            axes.plot(*ends, color=CONTACT, linewidth=1.8, zorder=5.0)
            marker: Any = {"marker": "o", "markersize": 5.0, "markeredgecolor": "#222222"}
            axes.plot(contact[right], contact[up], color=CONTACT, **marker, zorder=6.0)


def _direction(path: FloatArray, contact: FloatArray) -> FloatArray:
    """Task vector (3,) of the gripper's last way (P, 4, 4) to a contact, zero where unknown."""
    places = path[:, :3, 3]
    if len(places) == 0:
        return np.zeros(3)
    touching = int(np.argmin(((places - contact) ** 2).sum(axis=1)))
    ways = places[touching] - places[:touching]
    lengths = np.sqrt((ways**2).sum(axis=1))
    moved = np.flatnonzero(lengths > _MOVED)
    return ways[moved[-1]] / lengths[moved[-1]] if len(moved) else np.zeros(3)


def _set_frame(axes: Axes, frame: Frame) -> None:
    axes.set_xlim(frame.lower[0], frame.upper[0])
    axes.set_ylim(frame.lower[1], frame.upper[1])
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.tick_params(labelsize=9)


def _legend(figure: Figure, truth: bool) -> None:
    handles = [Line2D([], [], color="#888888", linewidth=1.2, label="hypotheses")]
    if truth:
        handles.append(Line2D([], [], color="#000000", linestyle="--", label="true pose"))
    contact = Line2D([], [], color=CONTACT, marker="o", label="contact, and the way to it")
    contact.set_markeredgecolor("#222222")
    figure.legend(handles=[*handles, contact], loc="outside lower center", ncols=3)
