"""Several methods on the same recorded problems, side by side in one Rerun recording."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from chsel.cost.compiled_cost import CompiledCost
from chsel.errors import RecordingError
from chsel.events import Probe, ProblemPosed
from chsel.problem.points import Workspace
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.trust import has_pose, trust_in
from replay.colors import SERIES, CostScale, number
from replay.comparing.comparison import CommonCost, common_cost, numbers_under
from replay.mcap.reader import Recording
from replay.rerun.curves import DEGREES, MILLIMETRES, style_curve
from replay.rerun.scene import HypothesisMeshes, Scene, coarsened, shown_hypotheses
from replay.rerun.stream import PROBE, new_file_stream
from replay.rerun.text import costs_markdown, literal
from replay.rerun.views import at_last_probe, curves_view, scene_view

APPLICATION = "chsel comparison"
CURVES: Mapping[str, tuple[str, float]] = {
    "log10_best_cost": ("log₁₀ best cost", 1.0),
    "log10_median_cost": ("log₁₀ median", 1.0),
    "best_position_error": ("Position error of the best [mm]", MILLIMETRES),
    "best_rotation_error": ("Rotation error of the best [°]", DEGREES),
    "closest_position_error": ("Position error of the closest [mm]", MILLIMETRES),
    "closest_rotation_error": ("Rotation error of the closest [°]", DEGREES),
    "spread": ("Spread [mm]", MILLIMETRES),
}
"""Numbers drawn over probes, a curve for each method: title of the view, and its unit."""
_COLUMNS = (  # of the views of curves
    ("log10_best_cost", "log10_median_cost"),
    ("best_position_error", "best_rotation_error"),
    ("closest_position_error", "closest_rotation_error"),
    ("spread",),
)
_WITH_LEGEND = "spread"  # of the view at the right edge: one legend serves all
_IN_A_ROW = 4  # views of methods
_FACES = 24_000  # of all methods' meshes of one colour together
_FEWEST_FACES = 1_000


def save_comparison(
    path: Path, recording: Recording, *, results: Mapping[str, Mapping[int, Hypotheses]]
) -> None:
    """Write a new .rrd: a 3-D view for each method, curves of all below, at the last of the steps.

    results: hypotheses by the label of a method, then by step; a method may lack steps. Costs,
    and with them the order of a step's hypotheses, are those of `common_cost`.
    Raise RecordingError if there is no result, a step has no problem, or the file cannot be
    written or exists; nothing is left of it then.
    """
    steps = sorted({step for found in results.values() for step in found})
    if not steps:
        raise RecordingError("there is no result to compare; accepted: at least one")
    recording.checked_steps(steps)
    with new_file_stream(path, APPLICATION) as stream:
        drawing = _Comparison(stream, recording, labels=list(results))
        drawn = set[int]()
        for event in recording.events(images=False):
            if isinstance(event, Probe):
                if event.step > steps[-1]:
                    break
                drawing.add_probe(event)
            elif isinstance(event, ProblemPosed) and event.step not in drawn:
                drawn.add(event.step)
                of_step = {name: by[event.step] for name, by in results.items() if event.step in by}
                if of_step:
                    drawing.add_results(event.problem, of_step)


class _Comparison:
    """One scene for all methods, and the results of each at entities of its number."""

    def __init__(
        self, stream: rr.RecordingStream, recording: Recording, *, labels: Sequence[str]
    ) -> None:
        start = recording.start
        self._stream, self._recording = stream, recording
        self._scene = Scene(stream)
        self._labels = list(labels)
        self._cost: CommonCost = common_cost(recording)
        self._meshes = [HypothesisMeshes(stream, f"hypotheses/{n}") for n in range(len(labels))]
        stream.send_recording_name(f"{start.object}, seed {start.seed}: {', '.join(labels)}")
        pose_known = start.world_from_object is not None
        stream.send_blueprint(_blueprint(start.workspace, self._labels, pose_known=pose_known))
        stream.set_time(PROBE, sequence=min((p.step for p in recording.probes), default=0))
        mesh = coarsened(start.mesh)
        self._scene.set_up(mesh, start.workspace, world_from_object=start.world_from_object)
        self._scene.add_points(start.initial_points)
        coarse = coarsened(mesh, max(_FACES // len(labels), _FEWEST_FACES))
        for n, label in enumerate(labels):
            self._meshes[n].set_up(coarse)
            for name in CURVES:
                style_curve(stream, f"curves/{name}/{n}", name=label, color=SERIES[n % len(SERIES)])

    def add_probe(self, probe: Probe) -> None:
        """Draw a probe in the scene."""
        self._stream.set_time(PROBE, sequence=probe.step)
        self._scene.add_probe(probe)

    def add_results(self, problem: RegistrationProblem, found: Mapping[str, Hypotheses]) -> None:
        """Draw the hypotheses of methods, by their labels, for one problem."""
        self._stream.set_time(PROBE, sequence=problem.key.step)
        with warnings.catch_warnings(action="ignore"):  # those that registered have been warned
            judge = CompiledCost.of(problem, self._cost.settings)
        judged = {label: ranked(hypotheses, judge) for label, hypotheses in found.items()}
        shown = [h.cost[shown_hypotheses(h)] for h in judged.values()]
        scale = CostScale.of(np.concatenate(shown))
        for n, label in enumerate(self._labels):
            hypotheses = judged.get(label)
            if hypotheses is None or len(hypotheses.cost) == 0:
                self._meshes[n].hide()
                self._summarise(n, "no result")
                continue
            self._meshes[n].draw(hypotheses, scale)
            start = self._recording.start_at(problem.key.step)
            numbers = numbers_under(judge, hypotheses, start=start)
            if has_pose(found[label]):
                numbers["spread"] = trust_in(problem, found[label]).spread
            for which in ("best", "median"):
                numbers[f"log10_{which}_cost"] = float(np.log10(numbers[f"{which}_cost"]))
            for name, (_, unit) in CURVES.items():
                if math.isfinite(numbers.get(name, math.nan)):
                    self._stream.log(f"curves/{name}/{n}", rr.Scalars(unit * numbers[name]))
            self._summarise(
                n, _summary(hypotheses, scale, cost=literal(self._cost.name), numbers=numbers)
            )

    def _summarise(self, n: int, text: str) -> None:
        """Write a text below the view of a method."""
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._stream.log(f"summary/{n}", document)


def ranked(hypotheses: Hypotheses, judge: CompiledCost) -> Hypotheses:
    """Return hypotheses with their costs by a judge, ascending.

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


def _summary(
    hypotheses: Hypotheses, scale: CostScale, *, cost: str, numbers: Mapping[str, float]
) -> str:
    errors = [
        f"{which} {MILLIMETRES * numbers[f'{which}_position_error']:.1f} mm, "
        f"{DEGREES * numbers[f'{which}_rotation_error']:.1f}°"
        for which in ("best", "closest")
        if f"{which}_position_error" in numbers
    ]
    rows = [
        f"best cost {number(numbers['best_cost'])} by {cost}; {'; '.join(errors)}",
        costs_markdown(hypotheses, scale),
    ]
    return "\n\n".join(rows)


def _blueprint(workspace: Workspace, labels: Sequence[str], *, pose_known: bool) -> rrb.Blueprint:
    """Return a view for each method, four in a row at most, and curves below."""
    count = len(labels)
    columns = count if count <= _IN_A_ROW else math.ceil(math.sqrt(count))
    methods = [
        rrb.Vertical(
            scene_view(workspace, name=label, more=[f"hypotheses/{n}"]),
            rrb.TextDocumentView(origin=f"/summary/{n}", name=f"{label}: result"),
            row_shares=[3, 1],
        )
        for n, label in enumerate(labels)
    ]
    curves = [
        rrb.Vertical(
            *(
                curves_view(f"curves/{name}", CURVES[name][0], legend=name == _WITH_LEGEND)
                for name in names
            )
        )
        for names in _COLUMNS
        if pose_known or not names[0].endswith("error")
    ]
    return at_last_probe(
        rrb.Vertical(
            rrb.Grid(*methods, grid_columns=columns), rrb.Horizontal(*curves), row_shares=[60, 40]
        )
    )
