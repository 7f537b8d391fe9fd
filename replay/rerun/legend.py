"""What the colours of the scene mean, as a strip below it."""

from __future__ import annotations

import numpy as np
import rerun as rr

from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import Hypotheses
from replay.colors import (
    CONTACT,
    FREE,
    GRIPPER,
    KNOWN,
    OBJECT,
    OCCUPIED,
    CostScale,
    Rgb,
    cost_colors,
    number,
)
from replay.rerun.hypotheses import LEVELS, shown_hypotheses
from replay.rerun.plane import Frame, lines, on_screen, texts

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
        names = [name for name in _KINDS if name in kinds]
        x = 0.7 + min(_ROOM[0] / len(names), _ROOM[1]) * np.arange(len(names))
        chips = rr.Points2D(
            np.stack([x, np.full(len(x), 0.25)], axis=1),
            colors=[_KINDS[name] for name in names],
            radii=on_screen(5.0),
            labels=names,
            show_labels=True,
        )
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
