"""What the colours of the scene mean, as strips below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import Hypotheses
from replay.colors import (
    CHOSEN,
    CONTACT,
    FORECAST,
    FREE,
    GRIPPER,
    KNOWN,
    OBJECT,
    OCCUPIED,
    UNAVAILABLE,
    CostScale,
    Rgb,
    ScoreScale,
    cost_colors,
    number,
    score_colors,
)
from replay.rerun.hypotheses import LEVELS, shown_hypotheses
from replay.rerun.plane import Frame, lines, on_screen, texts

if TYPE_CHECKING:
    from replay.events import Decided

LEGEND_FRAME = Frame(16.0, 1.0)
"""Size of the strip in units of its view."""
_KINDS: dict[str, Rgb] = {
    "contact": CONTACT,
    "free": FREE,
    "occupied": OCCUPIED,
    "known": KNOWN,
    "gripper": GRIPPER,
    "true pose": OBJECT,
}
_ACTIONS: dict[str, Rgb] = {
    "next": CHOSEN,
    "forecast": FORECAST,
    "not possible": UNAVAILABLE,
}
_SCORE_STEPS = 12
_USUAL = ("contact", "free", "gripper")
_ROOM = (8.7, 2.1)  # for all kinds, and at most for one
_BAR = (9.7, 12.7)  # left and right end of the cost bar


class Legend:
    """Draws the strip under the entity `root`."""

    def __init__(self, stream: rr.RecordingStream, root: str = "legend") -> None:
        self._stream = stream
        self._root = root
        self._kinds: set[str] = set()

    def set_up(self, *, pose_known: bool) -> None:
        """The kinds of things that every scene has, and the bar of cost steps."""
        self._show_kinds({*_USUAL, "true pose"} if pose_known else {*_USUAL})
        edges = np.linspace(*_BAR, LEVELS + 1)
        for level in range(LEVELS):
            red, green, blue = cost_colors((level + 0.5) / LEVELS).tolist()
            step = [(edges[level], 0.25), (edges[level + 1], 0.25)]
            bar = lines([step], (red, green, blue), width=12.0)
            self._stream.log(f"{self._root}/cost_step_{level + 1}", bar, static=True)

    def add_kinds(self, points: KnownPoints) -> None:
        """Name the kinds of points that not every scene has, once there are some."""
        there = {"occupied": points.occupied, "known": points.known[points.sdf != 0.0]}
        new = {name for name, some in there.items() if len(some)} - self._kinds
        if new:
            self._show_kinds(self._kinds | new)

    def _show_kinds(self, kinds: set[str]) -> None:
        self._kinds = kinds
        chips = _chips({name: color for name, color in _KINDS.items() if name in kinds})
        self._stream.log(f"{self._root}/kinds", chips, static=True)

    def draw(self, hypotheses: Hypotheses) -> None:
        """The costs at the ends of the bar, and how many hypotheses are drawn."""
        shown = shown_hypotheses(hypotheses)
        scale = CostScale.of(hypotheses.cost[shown])
        self.label(scale, f"{len(shown)} of {len(hypotheses.cost)} drawn")

    def label(self, scale: CostScale, note: str, *, at: float = 14.5) -> None:
        """The costs at the ends of the bar, and a note `at` a place beside it."""
        ends = [
            (_BAR[0], number(scale.low)),
            (sum(_BAR) / 2, "cost"),
            (_BAR[1], number(scale.high)),
        ]
        labels = [(x, 0.42, text) for x, text in ends]
        labels.append((at, 0.1, note))
        self._stream.log(f"{self._root}/cost", texts(labels))


class ScoreLegend:
    """Draws the strip of a steered session under the entity `root`."""

    def __init__(self, stream: rr.RecordingStream, root: str = "score_legend") -> None:
        self._stream = stream
        self._root = root

    def set_up(self) -> None:
        """The kinds of actions, and the bar of scores."""
        self._stream.log(f"{self._root}/kinds", _chips(_ACTIONS), static=True)
        edges = np.linspace(*_BAR, _SCORE_STEPS + 1)
        steps = [[(edges[n], 0.25), (edges[n + 1], 0.25)] for n in range(_SCORE_STEPS)]
        colors = score_colors((np.arange(_SCORE_STEPS) + 0.5) / _SCORE_STEPS)
        bar = lines(steps, *((int(r), int(g), int(b)) for r, g, b in colors), width=12.0)
        self._stream.log(f"{self._root}/bar", bar, static=True)

    def draw(self, event: Decided) -> None:
        """The scores at the ends of the bar, and what was chosen of how many."""
        decision = event.decision
        scale = ScoreScale.of(decision.score)
        can = int(np.isfinite(decision.score).sum())
        note = (
            f"stop: {decision.stop}" if decision.chosen < 0 else f"{can} action{'s' * (can != 1)}"
        )
        ends = [(_BAR[0], number(scale.low)), (_BAR[1], number(scale.high))] if can else []
        labels = [(x, 0.42, text) for x, text in (*ends, (sum(_BAR) / 2, "score"))]
        labels.append((14.5, 0.1, note))
        self._stream.log(f"{self._root}/score", texts(labels))


def _chips(kinds: Mapping[str, Rgb]) -> rr.Points2D:
    """A dot of its colour for each kind, and the name below it."""
    x = 0.7 + min(_ROOM[0] / len(kinds), _ROOM[1]) * np.arange(len(kinds))
    return rr.Points2D(
        np.stack([x, np.full(len(x), 0.25)], axis=1),
        colors=[*kinds.values()],
        radii=on_screen(5.0),
        labels=[*kinds],
        show_labels=True,
    )
