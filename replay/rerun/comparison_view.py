"""Several methods on the same recorded problems, side by side in one Rerun recording."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from math import degrees, isfinite, log10
from pathlib import Path

import numpy as np
import rerun as rr

from chsel.cost.compiled_cost import CompiledCost
from chsel.errors import RecordingError
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.trust import has_pose, trust_in
from replay.colors import SERIES, CostScale, Rgb, number
from replay.comparing.comparison import CommonCost, common_cost, numbers_under
from replay.events import Probe, ProblemPosed
from replay.mcap.reader import Recording
from replay.rerun.blueprint import bounds_in_sight
from replay.rerun.clock import PROBE, REGISTRATION
from replay.rerun.comparison_layout import (
    CURVES,
    SUMMARY_FRAME,
    comparison_blueprint,
    entity_names,
)
from replay.rerun.curves import SHOWN_UNIT, style_curve
from replay.rerun.hypotheses import HypothesisMeshes, shown_hypotheses
from replay.rerun.legend import Legend
from replay.rerun.meshes import bare_mesh, coarsened
from replay.rerun.plane import color_array, on_screen, texts
from replay.rerun.scene import Scene
from replay.rerun.stream import new_file_stream

APPLICATION = "chsel comparison"
_FACES = 24_000  # of all methods' meshes of one colour together
_FEWEST_FACES = 1_000
_ALPHA = (26, 10)  # on one scale for all methods, a good set may be on its lowest step alone
_NOTE = 15.2  # where the legend names the scale, in units of its view


def save_comparison(
    path: Path, recording: Recording, results: Mapping[str, Mapping[int, Hypotheses]]
) -> None:
    """Write a new .rrd: a 3-D view for each method, curves of all below, at the first of the steps.

    results: hypotheses by the label of a method, then by step; a method may lack steps. Costs,
    and with them the order of a step's hypotheses, are those of `common_cost`.
    Raises RecordingError if there is no result, a step has no problem, or the file cannot be
    written or exists; nothing is left of it then.
    """
    steps = {step for found in results.values() for step in found}
    if not steps:
        raise RecordingError("there is no result to compare; accepted: at least one")
    recording.checked_steps(sorted(steps))
    with new_file_stream(path, APPLICATION) as stream:
        _draw(stream, recording, results, steps)


def _draw(
    stream: rr.RecordingStream,
    recording: Recording,
    results: Mapping[str, Mapping[int, Hypotheses]],
    steps: set[int],
) -> None:
    drawing = _Comparison(stream, recording, tuple(results), min(steps))
    drawn: set[int] = set()
    for event in recording.events(images=False):
        if isinstance(event, Probe):
            if event.step > max(steps):
                return
            drawing.add_probe(event)
        elif isinstance(event, ProblemPosed) and event.step not in drawn:
            drawn.add(event.step)
            of_step = {name: by[event.step] for name, by in results.items() if event.step in by}
            if of_step:
                drawing.set_probe(event.step)
                drawing.add_results(event.problem, of_step)


class _Comparison:
    """Draws one scene for all, and the results of each method."""

    def __init__(
        self, stream: rr.RecordingStream, recording: Recording, labels: tuple[str, ...], first: int
    ) -> None:
        """first: the first step that is compared."""
        start = recording.start
        known = start.world_from_object is not None
        self.scene = Scene(stream)
        self._stream = stream
        self._first = first
        self._laid_out = False
        self._names = entity_names(labels)
        self._start = start
        self._cost: CommonCost = common_cost(recording)
        self._legend = Legend(stream)
        self._meshes = {
            label: HypothesisMeshes(stream, f"hypotheses/{name}")
            for label, name in self._names.items()
        }
        stream.send_recording_name(f"{start.object}, seed {start.seed}: {', '.join(labels)}")
        mesh = bare_mesh(start.mesh)
        self.set_probe(min((p.step for p in recording.probes), default=0))
        self.scene.set_up(mesh, start.workspace, start.world_from_object)
        self.scene.add_points(start.initial_points, new=False)
        self._legend.add_kinds(start.initial_points)
        self._legend.set_up(pose_known=known)
        coarse = coarsened(mesh, max(_FACES // len(labels), _FEWEST_FACES))
        for n, (label, meshes) in enumerate(self._meshes.items()):
            meshes.set_up(coarse, alpha=_ALPHA)
            self._style(label, SERIES[n % len(SERIES)])

    def set_probe(self, step: int) -> None:
        """All that is drawn from here on belongs to probe `step`.

        Of the timeline of registrations, all before the first step that is compared is its start.
        """
        self._stream.set_time(PROBE, sequence=step)
        self._stream.set_time(REGISTRATION, sequence=max(step, self._first))

    def add_probe(self, probe: Probe) -> None:
        """What a probe adds to the scene."""
        self.set_probe(probe.step)
        self.scene.add_probe(probe)
        self._legend.add_kinds(probe.new_points)

    def add_results(self, problem: RegistrationProblem, found: Mapping[str, Hypotheses]) -> None:
        """The hypotheses of methods, by their labels, for one problem."""
        with warnings.catch_warnings(action="ignore"):  # those that registered have been warned
            judge = CompiledCost.of(problem, self._cost.settings)
        judged = {label: ranked(hypotheses, judge) for label, hypotheses in found.items()}
        self._lay_out(judged)
        shown = [h.cost[shown_hypotheses(h)] for h in judged.values()]
        scale = CostScale.of(np.concatenate(shown))
        self._legend.label(scale, at=_NOTE, note=f"one scale for all:\n{self._cost.name}")
        for label, meshes in self._meshes.items():
            hypotheses = judged.get(label)
            if hypotheses is None or len(hypotheses.cost) == 0:
                meshes.hide()
                self._summarise(label, "no result")
            else:
                meshes.draw(hypotheses, scale)
                numbers = numbers_under(judge, hypotheses, self._start)
                if has_pose(found[label]):
                    numbers["spread"] = trust_in(problem, found[label]).spread
                self._add_numbers(label, numbers)
                count = f"{len(shown_hypotheses(hypotheses))} of {len(hypotheses.cost)} drawn"
                self._summarise(label, *_summary(numbers, count))

    def _lay_out(self, found: Mapping[str, Hypotheses]) -> None:
        """Make the views once there is something to look at."""
        if self._laid_out:
            return
        self._laid_out = True
        layout = comparison_blueprint(
            self._start.workspace,
            self._names,
            pose_known=self._start.world_from_object is not None,
            in_sight=bounds_in_sight(self._start, found.values()),
        )
        self._stream.send_blueprint(layout)

    def _add_numbers(self, label: str, numbers: Mapping[str, float]) -> None:
        values = dict(numbers)
        for name in ("best_cost", "median_cost"):
            if numbers[name] > 0.0:
                values[f"log10_{name}"] = log10(numbers[name])
        for name in CURVES.keys() & values.keys():
            if isfinite(values[name]):
                times = next((SHOWN_UNIT[kind] for kind in SHOWN_UNIT if kind in name), 1.0)
                self._stream.log(self._curve(name, label), rr.Scalars(times * values[name]))

    def _summarise(self, label: str, *rows: str) -> None:
        """Text below the view of a method."""
        place = SUMMARY_FRAME.width / 2, 0.1
        text = texts([(*place, "\n".join(rows))])
        self._stream.log(f"summary/{self._names[label]}/text", text)

    def _style(self, label: str, color: Rgb) -> None:
        """Name and colour the curves of a method, and say so below its view."""
        for name in CURVES:
            style_curve(self._stream, self._curve(name, label), label, color)
        chip = rr.Points2D([(0.35, 0.5)], colors=color_array(color), radii=on_screen(6.0))
        self._stream.log(f"summary/{self._names[label]}/color", chip, static=True)

    def _curve(self, name: str, label: str) -> str:
        return f"curves/{name}/{self._names[label]}"


def ranked(hypotheses: Hypotheses, judge: CompiledCost) -> Hypotheses:
    """The same hypotheses with their costs by a judge, ascending.

    Of poses that repeat each other, the one that was the first by its method's cost stays it.
    """
    cost = judge.evaluate(hypotheses.object_from_world)
    order = np.argsort(cost, kind="stable")
    return replace(
        hypotheses,
        object_from_world=hypotheses.object_from_world[order],
        cost=cost[order],
        duplicate=hypotheses.duplicate[order],
        cell=hypotheses.cell[order],
    )


def _summary(numbers: Mapping[str, float], count: str) -> list[str]:
    rows = [f"best cost {number(numbers['best_cost'])}, {count}"]
    errors = [
        f"{which} {1000.0 * numbers[f'{which}_position_error']:.1f} mm, "
        f"{degrees(numbers[f'{which}_rotation_error']):.1f}°"
        for which in ("best", "closest")
        if f"{which}_position_error" in numbers
    ]
    return [*rows, "; ".join(errors)] if errors else rows
