"""The interface of every registration method, and the base of those of this package."""

from __future__ import annotations

from typing import Any, Generic, Protocol, TypeVar

from chsel.numerics.threads import require_ieee_arithmetic
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)


class Method(Protocol):
    """A pure function of a problem and of its settings."""

    settings: Any
    """A frozen dataclass."""

    @property
    def online(self) -> OnlineSettings:
        """The making of a session's next problem for this method."""

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Return hypotheses, best first. The observer sees intermediate results alone."""


Settings = TypeVar("Settings", bound=Any)


class ConfiguredMethod(Generic[Settings]):
    """Base of a method whose settings have a field `online`; `settings_class` makes the default."""

    settings_class: type[Settings]

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.settings_class()

    @property
    def online(self) -> OnlineSettings:
        """The making of a session's next problem for this method."""
        online: OnlineSettings = self.settings.online
        return online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Return hypotheses for the known points of a problem, best first."""
        require_ieee_arithmetic()
        return self._hypotheses(problem, observer or NullObserver())

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        raise NotImplementedError
