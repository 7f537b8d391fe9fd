"""How contacts follow from a force sensor between the arm and the hand."""

from __future__ import annotations

from dataclasses import dataclass

from chsel.errors import SettingError, require_at_most, require_choice, require_positive

_MOST_POINTS = 1000
_LEAST_FORCE = 0.001  # N
_LONGEST = 1e6  # seconds, newtons, metres


@dataclass(frozen=True)
class ForceRig:
    """A topic of forces and torques on the hand."""

    topic: str
    frame: str | None = None  # in which, and about whose origin, they are; null: the messages'
    threshold: float = 3.0  # newtons beyond the tare, above which there is a contact
    samples: int = 3  # so many in a row; fewer are a spike
    acts: str = "on_hand"
    """Whether forces are those "on_hand", as the object pushes it, or "by_hand", as it pushes."""

    torque: bool = True
    """Whether torques tell where the contact is; otherwise it is where the hand is furthest against
    the force. Also used while all torques are 0."""

    tare: float = 1.0
    """Seconds before a probe's begin, whose median is subtracted: the hand's weight and drift."""

    reach: float = 0.01  # metres by which the line of force may miss the hand
    points: int = 5  # of a probe at most, the strongest of those in different voxels

    def __post_init__(self) -> None:
        for name in ("threshold", "tare", "reach"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _LONGEST)
        if self.threshold < _LEAST_FORCE:
            raise SettingError(
                f"threshold is {self.threshold:g} N; accepted: from {_LEAST_FORCE:g} N"
            )
        for name in ("samples", "points"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _MOST_POINTS)
        require_choice("acts", self.acts, ("on_hand", "by_hand"))
