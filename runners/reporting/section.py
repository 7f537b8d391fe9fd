"""A section of a report: a picture, or why there is none, and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from chsel.errors import require_choice
from runners.reporting.evaluation_folder import Evaluation, ReportError
from runners.reporting.figures import NotDrawn, Picture
from runners.reporting.method_style import MethodStyle, method_styles, policy_styles
from runners.reporting.silhouette import VIEWS
from runners.reporting.steered_sessions import SteeredSessions, steered_sessions
from runners.reporting.tables import Table

LAST_HALF = (
    "Numbers are pooled over trials (a configuration with a seed) and over the steps of the last "
    "half of every trial."
)
Styles = Mapping[str, MethodStyle]


@dataclass(frozen=True)
class SequenceConfig:
    """What the pictures of a single trial show."""

    trial: str | None = None  # such as "drill/0"; None: that of the median PD of CHSEL
    methods: tuple[str, ...] | None = None  # None: those of the paper's picture
    steps: tuple[int, ...] | None = None  # None: four of those that all methods have
    view: str = "xz"  # the axes of the world that are drawn

    def __post_init__(self) -> None:
        require_choice("view", self.view, VIEWS)
        for name in ("methods", "steps"):
            if getattr(self, name) == ():
                raise ReportError(f"{name} is empty; accepted: at least one, or null")


@dataclass(frozen=True)
class Subject:
    """What a report is about: an evaluation, and what was asked for."""

    evaluation: Evaluation
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    baseline: str | None = None  # a method, or policy, to compare all others with

    @property
    def asks(self) -> bool:
        """Whether pictures of a single trial were asked for."""
        return self.sequence != SequenceConfig()

    @cached_property
    def styles(self) -> Styles:
        """All methods in the order in which figures and tables have them, with their looks."""
        return method_styles(self.evaluation.planned_methods)

    @cached_property
    def sessions(self) -> SteeredSessions:
        """Those of policies."""
        return steered_sessions(self.evaluation, self.baseline)

    @cached_property
    def policy_styles(self) -> Styles:
        """All policies that were asked for or have a session, with their looks."""
        return policy_styles(self.evaluation.planned_policies)

    def styles_of(self, methods: Sequence[str]) -> Styles:
        """The same of some methods."""
        return {method: style for method, style in self.styles.items() if method in methods}


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    name: str  # of its anchor
    title: str
    text: str  # what is shown and how it comes about
    picture: Picture | None = None
    missing: str = ""  # why there is no picture
    tables: tuple[Table, ...] = ()


def drawn(draw: Callable[[], Picture]) -> tuple[Picture | None, str]:
    """A picture, or why there is none: two fields of a Section."""
    try:
        return draw(), ""
    except NotDrawn as reason:
        return None, str(reason)
