"""What every registration method offers."""

from __future__ import annotations

from typing import Any, Protocol

from chsel.problem.online_registration import OnlineSettings
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem


class Method(Protocol):
    """A pure function of a problem, with settings of its own."""

    settings: Any
    """A frozen dataclass."""

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem for this method."""

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses, best first. The observer sees the way there and changes nothing."""
