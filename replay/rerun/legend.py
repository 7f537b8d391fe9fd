"""What the colours of the scene mean, as a strip below it."""

from __future__ import annotations

import numpy as np
import rerun as rr

from chsel.problem import Hypotheses
from replay.rerun.colors import (
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
_BAR = (9.7, 12.7)  # left and right end of the cost bar


class Legend:
    """Draws the strip under the entity `root`."""

    def __init__(self, stream: rr.RecordingStream, root: str = "legend") -> None:
        self._stream = stream
        self._root = root

    def set_up(self, *, pose_known: bool) -> None:
        """The kinds of things in the scene, and the bar of cost steps."""
        kinds = {name: color for name, color in _KINDS.items() if pose_known or color != OBJECT}
        x = 0.7 + 1.45 * np.arange(len(kinds))
        chips = rr.Points2D(
            np.stack([x, np.full(len(x), 0.25)], axis=1),
            colors=list(kinds.values()),
            radii=on_screen(5.0),
            labels=list(kinds),
            show_labels=True,
        )
        self._stream.log(f"{self._root}/kinds", chips, static=True)
        edges = np.linspace(*_BAR, LEVELS + 1)
        for level in range(LEVELS):
            red, green, blue = cost_colors((level + 0.5) / LEVELS).tolist()
            step = [(edges[level], 0.25), (edges[level + 1], 0.25)]
            bar = lines([step], (red, green, blue), width=12.0)
            self._stream.log(f"{self._root}/cost_step_{level + 1}", bar, static=True)

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
