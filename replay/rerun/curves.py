"""Numbers of a session as curves: over probes, and over the iterations of the search."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from chsel.events import Traced
from chsel.problem.registration_problem import Hypotheses
from replay.colors import COSTS, SERIES, Rgb
from replay.rerun.stream import ITERATION

MILLIMETRES = 1e3
DEGREES = math.degrees(1.0)
_MEASURED = {  # where measured numbers are drawn, by part of their names, and the unit there
    "position_error": ("error/position", MILLIMETRES),
    "rotation_error": ("error/rotation", DEGREES),
    "estimated_noise": ("trust", MILLIMETRES),
    "set_spread": ("trust", MILLIMETRES),
    "spread_limit": ("trust", MILLIMETRES),
    "centre_within": ("trust", MILLIMETRES),
    "turn_within": ("measured", DEGREES),
    "": ("measured", 1.0),
}
_OF_HYPOTHESES = "distinct_hypotheses"  # a measured number that the hypotheses show


class Curves:
    """Scalars at entities VIEW/NAME; lengths in millimetres and angles in degrees, as printed."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.views: set[str] = set()  # those that have something to show
        self._stream = stream
        self._named: list[str] = []

    def add(self, entity: str, value: float, *, color: Rgb | None = None) -> None:
        """Add a number at this moment, by default in the next colour of its view."""
        if math.isfinite(value):
            self._style(entity, color)
            self._stream.log(entity, rr.Scalars(value))

    def add_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Add lowest, median and highest cost of the hypotheses, and how many differ."""
        cost = hypotheses.cost
        if len(cost):
            values = (cost.min(), np.median(cost), cost.max())
            for (name, color), value in zip(COSTS.items(), values, strict=True):
                self.add(f"cost/{name}", float(value), color=color)
        self.add("distinct/hypotheses", float(hypotheses.distinct))

    def add_measured(self, name: str, value: float) -> None:
        """Add one measured number to the view that its name chooses."""
        if name != _OF_HYPOTHESES:
            part = next(part for part in _MEASURED if part in name)
            view, unit = _MEASURED[part]
            self.add(f"{view}/{name.removesuffix(f'_{part}')}", unit * value)

    def add_trace(self, iteration: int, traced: Traced) -> None:
        """Add costs of the search, which have no place on the timeline of probes."""
        for (name, color), cost in zip(COSTS.items(), traced.costs, strict=True):
            if math.isfinite(cost):
                self._style(f"search/{name}", color)
                moment = rr.TimeColumn(ITERATION, sequence=[iteration])
                self._stream.send_columns(
                    f"search/{name}", [moment], rr.Scalars.columns(scalars=[cost])
                )

    def _style(self, entity: str, color: Rgb | None) -> None:
        """Name and colour a curve, once."""
        if entity not in self._named:
            view, _, name = entity.rpartition("/")
            siblings = sum(other.rpartition("/")[0] == view for other in self._named)
            self._named.append(entity)
            self.views.add(view)
            style_curve(
                self._stream,
                entity,
                name=name.replace("_", " "),
                color=color or SERIES[siblings % 7],
            )


def style_curve(stream: rr.RecordingStream, entity: str, *, name: str, color: Rgb) -> None:
    """Name and colour the curve at an entity."""
    line = rr.SeriesLines(names=[name], colors=[color], widths=[2.0])
    point = rr.SeriesPoints(names=[name], colors=[color], marker_sizes=[2.5])
    stream.log(entity, line, point, static=True)
