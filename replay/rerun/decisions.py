"""Decisions on the next probe: actions coloured by score, the chosen one, and what it forecasts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import BoolArray, FloatArray
from replay.colors import (
    CHOSEN,
    FORECAST,
    SERIES,
    UNAVAILABLE,
    Rgb,
    ScoreScale,
    number,
    score_colors,
)
from replay.rerun.curves import SHOWN_UNIT, style_curve
from replay.rerun.legend import ScoreLegend
from replay.rerun.plane import color_array, on_screen

if TYPE_CHECKING:
    from chsel.next_probe.decision_problem import Actions
    from replay.events import Decided, Probe

_ARROW = 0.06  # longest arrow of an action, in diagonals of the box around all their starts
_WIDTHS = (1.5, 0.7)  # of the arrows of actions that can be taken and that cannot, points
_CURVES: dict[str, tuple[str, Rgb]] = {
    "spread/after": ("spread", SERIES[0]),
    "spread/expected": ("expected before the probe", SERIES[1]),
    "hit/forecast": ("forecast chance", SERIES[1]),
    "surprise/outcome": ("surprise", SERIES[3]),
}
_OUTCOME = "hit/outcome"
DECISION_CURVES = {
    "spread": "Spread and its forecast [mm]",
    "hit": "Hit: chance, and outcome as dots",
    "surprise": "Surprise [nats]",
}
"""What the curves of decisions show, by the last part of their view's entity."""
_STOPPED = {
    "spread": "the spread is small enough",
    "gain": "no action promises enough",
    "actions": "no action is left",
    "budget": "the budget is spent",
}


class Decisions:
    """All that is drawn of decisions, in the scene, below it, as curves and in the log."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.offered = False  # whether the session is steered
        self._stream = stream
        self._arrows = ActionArrows(stream)
        self._legend = ScoreLegend(stream)
        self._curves = DecisionCurves(stream)

    def set_up(self, actions: Actions) -> None:
        """What does not change."""
        self.offered = True
        self._arrows.set_up(actions)
        self._legend.set_up()
        self._curves.set_up()

    def draw(self, event: Decided) -> None:
        """A decision."""
        self._arrows.draw(event)
        self._legend.draw(event)
        self._curves.add(event)
        self._stream.log("log", rr.TextLog(_text(event), level=rr.TextLogLevel.INFO))

    def add_probe(self, probe: Probe) -> None:
        """What a probe met."""
        self._curves.add_probe(probe)


class ActionArrows:
    """Draws the actions of a session under the entity `root`: where they start, and their way."""

    def __init__(self, stream: rr.RecordingStream, root: str = "scene/actions") -> None:
        self._stream = stream
        self._root = root

    def set_up(self, actions: Actions) -> None:
        """Store an arrow for each action, all of them unavailable yet."""
        if len(actions) == 0:
            return
        starts, ways = _starts(actions), _ways(actions)
        size = float(np.linalg.norm(np.ptp(np.concatenate([starts, starts + ways]), axis=0)))
        longest = min(_ARROW * size, float(actions.length.max()))
        vectors = ways * (np.minimum(longest, actions.length) / actions.length)[:, None]
        arrows = rr.Arrows3D.from_fields(
            origins=starts.astype(np.float32), vectors=vectors.astype(np.float32)
        )
        self._stream.log(f"{self._root}/offered", arrows, static=True)

    def draw(self, event: Decided) -> None:
        """Colour the actions by score, and show the chosen one with the contacts it forecasts."""
        decision, actions = event.decision, event.problem.actions
        can = np.isfinite(decision.score)
        colors = np.full((len(can), 3), UNAVAILABLE, dtype=np.uint8)
        colors[can] = score_colors(ScoreScale.of(decision.score).fraction(decision.score[can]))
        self._log(
            "offered",
            rr.Arrows3D.from_fields(colors=colors, radii=_radii(can)),
            rr.AnyValues(
                score=decision.score,
                hit_chance=decision.hit_chance,
                blocked_chance=decision.blocked_chance,
                expected_spread=decision.expected_spread,
            ),
        )
        chosen = [decision.chosen] if decision.chosen >= 0 else []
        starts, ends = _starts(actions)[chosen], (_starts(actions) + _ways(actions))[chosen]
        way = rr.Arrows3D(
            origins=starts.astype(np.float32),
            vectors=(ends - starts).astype(np.float32),
            colors=color_array(CHOSEN),
            radii=on_screen(2.2),
        )
        self._log("chosen", way)
        met = decision.contacts[np.isfinite(decision.contacts).all(axis=1)]
        contacts = rr.Points3D(
            met.astype(np.float32), colors=color_array(FORECAST), radii=on_screen(3.0)
        )
        self._log("forecast", contacts)

    def _log(self, name: str, what: rr.AsComponents, *more: rr.AsComponents) -> None:
        self._stream.log(f"{self._root}/{name}", what, *more)


class DecisionCurves:
    """Spread, hits and surprise over the session, each beside what was forecast before the probe.

    A forecast stands at the probe that it is of.
    """

    def __init__(self, stream: rr.RecordingStream, root: str = "decision") -> None:
        self._stream = stream
        self._root = root
        self._hit_chance: float | None = None  # of the probe that comes
        self._expected: float | None = None  # spread after it, metres

    def set_up(self) -> None:
        """Names and colours."""
        for name, (text, color) in _CURVES.items():
            style_curve(self._stream, f"{self._root}/{name}", text, color)
        outcome = rr.SeriesPoints(names=["hit"], colors=[SERIES[0]], marker_sizes=[4.0])
        self._stream.log(f"{self._root}/{_OUTCOME}", outcome, static=True)

    def add_probe(self, probe: Probe) -> None:
        """Whether a probe hit, beside the chance of it; nothing of one that no decision led to."""
        if self._hit_chance is not None:
            self._scalar("hit/forecast", self._hit_chance)
            self._scalar(_OUTCOME, float(len(probe.contacts) > 0))
            self._hit_chance = None

    def add(self, event: Decided) -> None:
        """The spread that a decision found, and the surprise of the probe before it."""
        decision = event.decision
        self._scalar("spread/after", SHOWN_UNIT["position"] * decision.spread)
        if self._expected is not None:
            self._scalar("spread/expected", SHOWN_UNIT["position"] * self._expected)
            self._scalar("surprise/outcome", event.surprise)
        self._hit_chance = self._expected = None
        if decision.chosen >= 0:
            self._hit_chance = float(decision.hit_chance[decision.chosen])
            self._expected = float(decision.expected_spread[decision.chosen])

    def _scalar(self, name: str, value: float) -> None:
        if np.isfinite(value):
            self._stream.log(f"{self._root}/{name}", rr.Scalars(value))


def _text(event: Decided) -> str:
    """A line about a decision for the log."""
    decision = event.decision
    spread = f"spread {number(SHOWN_UNIT['position'] * decision.spread)} mm"
    if decision.chosen < 0:
        return f"stop, {_STOPPED.get(decision.stop, decision.stop)}: {spread}"
    expected = SHOWN_UNIT["position"] * decision.expected_spread[decision.chosen]
    return (
        f"next action {decision.chosen} of {len(decision.score)}: "
        f"score {number(decision.score[decision.chosen])}, "
        f"hits by {decision.hit_chance[decision.chosen]:.0%}; "
        f"{spread}, {number(expected)} mm expected"
    )


def _starts(actions: Actions) -> FloatArray:
    """Where the hand starts (A, 3), world, metres."""
    return actions.world_from_hand[:, :3, 3]


def _ways(actions: Actions) -> FloatArray:
    """The hand's way (A, 3) unless it meets something, world, metres."""
    return actions.world_from_hand[:, :3, 2] * actions.length[:, None]


def _radii(can: BoolArray) -> FloatArray:
    """Half the width (A,) of each arrow; below 0: in points of the screen."""
    return -0.5 * np.where(can, *_WIDTHS)
