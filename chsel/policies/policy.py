"""What every policy offers, and the part of it that those of this package share."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Any, Generic, Protocol, TypeVar

import numpy as np

from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Decision, DecisionProblem
from chsel.next_probe.forecast import BeliefSettings, Forecast, SurpriseSettings
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.trust import DETERMINED, MOST_WIDTH

MOST_PROBES = 100_000
LEAST_GAIN = 0.001  # diameters that a probe has to promise


class Policy(Protocol):
    """A pure function of a decision problem and of its settings."""

    settings: Any
    """A frozen dataclass, `PolicySettings` or one derived from it."""

    def decide(self, problem: DecisionProblem) -> Decision:
        """Scores and forecasts of all actions, and which of them to take, if any."""


@dataclass(frozen=True)
class StopSettings(CheckedSettings):
    """When no further probe is made. 0 switches a rule off."""

    # Of the belief, at most, metres; None: as soon as the result is determined. Where the verdict
    # on the result is known, it has to be determined in any case.
    spread: Annotated[float | None, not_negative] = None
    # Promised by the best action, at least, metres; None: LEAST_GAIN diameters of the object.
    gain: Annotated[float | None, not_negative] = None

    def is_narrow(self, spread: float, diameter: float, *, verdict: str) -> bool:
        """Whether to stop by the spread of a belief, metres, on an object of a diameter, metres.

        verdict: on the result that the belief is of, "" if there is none.
        """
        if self.spread == 0.0 or verdict not in ("", DETERMINED):
            return False
        if self.spread is None:
            return verdict == DETERMINED or spread <= MOST_WIDTH * diameter
        return spread <= self.spread

    def is_useless(self, promised: float, diameter: float) -> bool:
        """Whether to stop as the best action promises so little, metres."""
        least = LEAST_GAIN * diameter if self.gain is None else self.gain
        return 0.0 < least > promised


@dataclass(frozen=True)
class PolicySettings(CheckedSettings):
    """Settings of every policy."""

    probes: Annotated[int, positive, at_most(MOST_PROBES)] = 30  # the budget of a session
    # Standard deviation of a contact's place from where a pose of the belief has it, metres.
    noise: Annotated[float, positive] = 0.002
    # Actions to whose starts the object is in the way with a larger chance are not taken.
    blocked: Annotated[float, not_negative, at_most(1.0)] = 0.05
    stop: StopSettings = field(default_factory=StopSettings)
    actions: ActionSettings = field(default_factory=ActionSettings)
    belief: BeliefSettings = field(default_factory=BeliefSettings)
    surprise: SurpriseSettings = field(default_factory=SurpriseSettings)


Settings = TypeVar("Settings", bound=PolicySettings)


class ConfiguredPolicy(Generic[Settings]):
    """Base of policies that rate every action; `settings_class` makes the default settings.

    A rating is a gain, not negative, or with `is_gain` False any number that orders the actions.
    Gains are divided by the seconds that actions take, where these are known.
    """

    settings_class: type[Settings]
    is_gain = True

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.settings_class()

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Return a rating (A,) of all actions of a problem: the higher the better."""
        raise NotImplementedError

    def decide(self, problem: DecisionProblem) -> Decision:
        """Return the available action of the highest rating, the first of several, or a stop."""
        forecast = Forecast(problem, self.settings.noise)
        rating = self.rate(problem, forecast)
        if self.is_gain and problem.actions.seconds is not None:
            rating = rating / problem.actions.seconds
        feasible = problem.available & (forecast.blocked_chance <= self.settings.blocked)
        stop = self._stop(problem, forecast, feasible=feasible)
        score = np.where(feasible, rating, -inf)
        chosen = -1 if stop else int(np.argmax(score))
        contacts = np.zeros((0, 3))
        if chosen >= 0:
            met = forecast.hit[:, chosen, None]
            contacts = np.where(met, forecast.first.contact[:, chosen], np.nan)
        return Decision(
            chosen=chosen,
            stop=stop,
            spread=forecast.spread,
            score=score,
            hit_chance=forecast.hit_chance,
            blocked_chance=forecast.blocked_chance,
            expected_spread=forecast.gains.expected_spread,
            contacts=contacts,
        )

    def _stop(self, problem: DecisionProblem, forecast: Forecast, *, feasible: BoolArray) -> str:
        """Return why no probe is made, "" if one is."""
        stop, diameter = self.settings.stop, problem.sdf.diameter
        if problem.key.step >= self.settings.probes:
            return "budget"
        if stop.is_narrow(forecast.spread, diameter, verdict=problem.verdict):
            return "spread"
        if not feasible.any():
            return "actions"
        promised = forecast.spread - float(forecast.gains.expected_spread[feasible].min())
        return "gain" if stop.is_useless(promised, diameter) else ""
