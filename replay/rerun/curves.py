"""Numbers of a session as curves: over probes, and over the iterations of one registration."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from chsel.problem.registration_problem import Hypotheses
from replay.colors import CURVES, SERIES, CostScale, Rgb, number
from replay.events import Traced
from replay.rerun.clock import ITERATION
from replay.rerun.plane import Frame, Label, lines, texts, ticks

SEARCH_FRAME = Frame(1.5, 1.0)
_CURVE_NAMES = ("lowest", "median", "highest")
SHOWN_UNIT = {"position": 1e3, "rotation": math.degrees(1.0), "spread": 1e3}
"""What turns metres and radians into the units shown, millimetres and degrees."""
_OF_TRUST = ("estimated_noise", "set_spread")  # measured lengths, metres
_AT_ONCE = 64  # blocks of iterations that are sent together


class Curves:
    """Scalars over probes: costs, pose errors, seconds by stage, and all else measured.

    Lengths are in millimetres and angles in degrees, as on the console.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._named: set[str] = set()
        self._traced: list[tuple[int, tuple[float, float, float]]] = []

    def set_up(self) -> None:
        """The curves that every session has."""
        for name, color in CURVES.items():
            self._style(f"cost/{name}", name, color)
            self._style(f"search/{name}", name, color)

    def add_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Lowest, median and highest cost of the hypotheses, and how many differ."""
        cost = hypotheses.cost
        if len(cost):
            values = (cost.min(), np.median(cost), cost.max())
            for name, value in zip(_CURVE_NAMES, values, strict=True):
                self._scalar(f"cost/{name}", name, float(value))
        self._scalar("distinct/hypotheses", "distinct hypotheses", float(hypotheses.distinct))

    def add_measured(self, name: str, value: float) -> None:
        """One measured number; its name says where it is shown."""
        if name == "distinct_hypotheses":  # which the hypotheses show
            return
        text = name.replace("_", " ")
        for kind in ("position", "rotation"):
            if f"{kind}_error" in name:
                label, shown = text.replace(f" {kind} error", ""), SHOWN_UNIT[kind] * value
                self._scalar(f"error/{kind}/{name}", label, shown)
                return
        if name in _OF_TRUST:
            self._scalar(f"trust/{name}", text, SHOWN_UNIT["position"] * value)
        else:
            self._scalar(f"measured/{name}", text, value)

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Wall-clock time of a stage."""
        self._scalar(f"seconds/{stage.replace(' ', '_')}", stage.replace("_", " "), seconds)

    def add_trace(self, iteration: int, traced: Traced) -> None:
        """Costs of the search at this moment of the timeline of iterations; sent in blocks."""
        self._traced.append((iteration, traced.costs))
        if len(self._traced) == _AT_ONCE:
            self.send_traces()

    def send_traces(self) -> None:
        """Send what has not been sent yet. It has no place on the timeline of probes."""
        iterations = np.array([iteration for iteration, _ in self._traced], dtype=np.int64)
        costs = np.array([costs for _, costs in self._traced]).reshape(-1, len(_CURVE_NAMES))
        self._traced = []
        for column, name in enumerate(_CURVE_NAMES):
            finite = np.isfinite(costs[:, column])
            if finite.any():
                self._style(f"search/{name}", name)
                moments = rr.TimeColumn(ITERATION, sequence=iterations[finite])
                values = rr.Scalars.columns(scalars=costs[finite, column])
                self._stream.send_columns(f"search/{name}", [moments], values)

    def _scalar(self, entity: str, name: str, value: float) -> None:
        if not np.isfinite(value):
            return
        self._style(entity, name)
        self._stream.log(entity, rr.Scalars(value))

    def _style(self, entity: str, name: str, color: Rgb | None = None) -> None:
        """Name and colour a curve, once; by default, the next colour of its view."""
        if entity in self._named:
            return
        siblings = sum(
            other.rpartition("/")[0] == entity.rpartition("/")[0] for other in self._named
        )
        self._named.add(entity)
        style_curve(self._stream, entity, name, color or SERIES[siblings % len(SERIES)])


def style_curve(stream: rr.RecordingStream, entity: str, name: str, color: Rgb) -> None:
    """Name and colour the curve at an entity."""
    line = rr.SeriesLines(names=[name], colors=[color], widths=[2.0])
    point = rr.SeriesPoints(names=[name], colors=[color], marker_sizes=[2.5])
    stream.log(entity, line, point, static=True)


class SearchPlot:
    """The costs over the iterations of one registration, drawn under the entity `root`.

    A plot of its own: on the timeline of probes, all iterations of a registration are one moment.
    """

    def __init__(self, stream: rr.RecordingStream, root: str = "search_plot") -> None:
        self._stream = stream
        self._root = root
        self._points: list[tuple[int, tuple[float, float, float]]] = []
        self._stages: list[tuple[int, str]] = []
        self._walls: list[list[tuple[float, float]]] = []  # between stages, as they were drawn last

    def start(self) -> None:
        """A registration starts."""
        self._points, self._stages = [], []

    def add(self, iteration: int, traced: Traced) -> None:
        """A block of iterations is done; `iteration` counts those of all stages."""
        if not self._stages or self._stages[-1][1] != traced.stage:
            self._stages.append((iteration, traced.stage))
        self._points.append((iteration, traced.costs))

    def draw(self, step: int) -> None:
        """Draw the whole registration."""
        if not self._points:
            return
        iterations = np.array([iteration for iteration, _ in self._points], dtype=np.float64)
        costs = np.array([costs for _, costs in self._points])
        scale = CostScale.of(costs)
        last = max(float(iterations[-1]), 1.0)
        x = SEARCH_FRAME.width * iterations / last
        y = (1.0 - scale.fraction(costs)) * SEARCH_FRAME.height
        strips = [np.stack([x, y[:, column]], axis=1) for column in range(len(_CURVE_NAMES))]
        colors = [CURVES[name] for name in _CURVE_NAMES]
        self._stream.log(f"{self._root}/curves", lines(strips, *colors, width=2.0))
        starts = [SEARCH_FRAME.width * first / last for first, _ in self._stages]
        walls = [[(start, 0.0), (start, SEARCH_FRAME.height)] for start in starts]
        if walls != self._walls:
            self._walls = walls
            self._stream.log(f"{self._root}/frame", lines([*SEARCH_FRAME.outline(), *walls]))
        labels = self._labels(step, scale, last)
        self._stream.log(f"{self._root}/axes", texts(labels))

    def _labels(self, step: int, scale: CostScale, last: float) -> list[Label]:
        labels: list[Label] = [
            (SEARCH_FRAME.x(value / last), 1.05, number(value))
            for value in ticks(0.0, last, most=4)
        ]
        for place in (0.0, 0.5, 1.0):
            labels.append((-0.18, SEARCH_FRAME.y(place) - 0.06, number(scale.cost_at(place))))
        for row, (first, stage) in enumerate(self._stages):  # neighbours may be narrow
            height = -0.2 - 0.14 * (row % 2)
            labels.append((SEARCH_FRAME.x(first / last) + 0.1, height, stage.replace("_", " ")))
        labels.append((SEARCH_FRAME.width / 2, 1.2, f"iteration, probe {step}"))
        return labels
