"""Decisions on the next probe: actions coloured by score, the chosen one, and what it forecasts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray
from replay.colors import CHOSEN, FORECAST, UNAVAILABLE, number, score_colors, score_fractions
from replay.rerun.curves import MILLIMETRES, Curves
from replay.rerun.scene import on_screen

if TYPE_CHECKING:
    from chsel.events import Decided, Probe
    from chsel.next_probe.decision_problem import Actions

_ARROW = 0.06  # longest arrow of an action, in diagonals of the box around all their starts
_WIDTHS = (0.75, 0.35)  # radii of the arrows of actions that can be taken and that cannot, points


class Decisions:
    """Drawings of decisions, in the scene, as curves and in the log.

    A forecast stands at the probe that it is of.
    """

    def __init__(self, stream: rr.RecordingStream, curves: Curves) -> None:
        self._stream = stream
        self._curves = curves
        self._hit_chance: float | None = None  # of the probe that comes
        self._expected: float | None = None  # spread after it, metres

    def set_up(self, actions: Actions) -> None:
        """Store an arrow for each action, from now on until others are offered."""
        if len(actions) == 0:
            return
        starts, ways = _starts(actions), _ways(actions)
        size = float(np.linalg.norm(np.ptp(np.concatenate([starts, starts + ways]), axis=0)))
        longest = min(_ARROW * size, float(actions.length.max()))
        vectors = ways * (np.minimum(longest, actions.length) / actions.length)[:, None]
        arrows = rr.Arrows3D.from_fields(origins=starts, vectors=vectors)
        self._stream.log("scene/actions/offered", arrows)

    def draw(self, event: Decided) -> None:
        """Colour the actions by score, and show the chosen one with the contacts it forecasts."""
        decision = event.decision
        actions = event.problem.actions
        can = np.isfinite(decision.score)
        colors = np.full((len(can), 3), UNAVAILABLE, dtype=np.uint8)
        colors[can] = score_colors(score_fractions(decision.score[can]))
        radii = -np.where(can, *_WIDTHS)  # below 0: in points of the screen
        numbers = rr.AnyValues(
            score=decision.score,
            hit_chance=decision.hit_chance,
            blocked_chance=decision.blocked_chance,
            expected_spread=decision.expected_spread,
        )
        offered = rr.Arrows3D.from_fields(colors=colors, radii=radii)
        self._stream.log("scene/actions/offered", offered, numbers)
        chosen = [decision.chosen] if decision.chosen >= 0 else []
        way = rr.Arrows3D(
            origins=_starts(actions)[chosen],
            vectors=_ways(actions)[chosen],
            colors=[CHOSEN],
            radii=on_screen(2.2),
        )
        self._stream.log("scene/actions/chosen", way)
        met = decision.contacts[np.isfinite(decision.contacts).all(axis=1)]
        contacts = rr.Points3D(met, colors=[FORECAST], radii=on_screen(3.0))
        self._stream.log("scene/actions/forecast", contacts)
        self._stream.log("log", rr.TextLog(_text(event), level=rr.TextLogLevel.INFO))
        self._add_curves(event)

    def add_probe(self, probe: Probe) -> None:
        """Draw whether a probe hit, beside its forecast; nothing without a decision before it."""
        if self._hit_chance is not None:
            self._curves.add("decision/hit/forecast_chance", self._hit_chance)
            self._curves.add("decision/hit/outcome", float(len(probe.contacts) > 0))
            self._hit_chance = None

    def _add_curves(self, event: Decided) -> None:
        """Add the spread that a decision found, and the surprise of the probe before it."""
        decision = event.decision
        self._curves.add("decision/spread/spread", MILLIMETRES * decision.spread)
        if self._expected is not None:
            self._curves.add("decision/spread/expected", MILLIMETRES * self._expected)
            self._curves.add("decision/surprise/surprise", event.surprise)
        self._hit_chance = self._expected = None
        if decision.chosen >= 0:
            self._hit_chance = float(decision.hit_chance[decision.chosen])
            self._expected = float(decision.expected_spread[decision.chosen])


def _text(event: Decided) -> str:
    """Return a line about a decision for the log."""
    decision = event.decision
    spread = f"spread {number(MILLIMETRES * decision.spread)} mm"
    if decision.chosen < 0:
        return f"stop by {decision.stop}: {spread}"
    expected = MILLIMETRES * decision.expected_spread[decision.chosen]
    return (
        f"next action {decision.chosen} of {len(decision.score)}: "
        f"score {number(decision.score[decision.chosen])}, "
        f"hits by {decision.hit_chance[decision.chosen]:.0%}; "
        f"{spread}, {number(expected)} mm expected"
    )


def _starts(actions: Actions) -> FloatArray:
    """Return the start (A, 3) of the hand in each action, world, metres."""
    return actions.world_from_hand[:, :3, 3]


def _ways(actions: Actions) -> FloatArray:
    """Return the hand's way (A, 3) unless it meets something, world, metres."""
    return actions.world_from_hand[:, :3, 2] * actions.length[:, None]
