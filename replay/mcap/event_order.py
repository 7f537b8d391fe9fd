"""In which order the events of a session can come."""

from __future__ import annotations

from chsel.errors import RecordingError
from replay.events import (
    Event,
    HypothesesFound,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from replay.mcap.schemas import BEFORE_ALL_STEPS


class EventOrder:
    """Follows the events of one session: steps ascend, and a step has one problem, one result."""

    def __init__(self) -> None:
        self.step = BEFORE_ALL_STEPS  # of the last event
        self._probe = BEFORE_ALL_STEPS  # of the last probe
        self._posed = BEFORE_ALL_STEPS  # of the last problem
        self._registering = False  # a problem is posed and has no result yet
        self.has_rig = False
        self._ended = False

    def take(self, event: Event) -> None:
        """Raise RecordingError unless an event can follow those before it."""
        if isinstance(event, SessionStarted):
            return
        self._advance(event.step)
        match event:
            case Probe():
                if event.step <= self._probe:
                    raise RecordingError(f"probe {event.step} follows probe {self._probe}")
                self._probe = event.step
            case RigDescribed():
                if self.has_rig or event.step != BEFORE_ALL_STEPS:
                    raise RecordingError(
                        f"there is a rig of step {event.step}; accepted: one, before all steps"
                    )
                self.has_rig = True
            case SensorImage():
                self._see(event.step)
            case ProblemPosed():
                self._pose(event.step)
            case SnapshotTaken() | Traced() | HypothesesFound():
                if not self._registering or event.step != self._posed:
                    kind = type(event).__name__
                    raise RecordingError(f"{kind} of step {event.step} is in no registration of it")
                self._registering = not isinstance(event, HypothesesFound)
            case SessionEnded():
                self._ended = True

    def pose(self, step: int) -> None:
        """The same for the problem of a step."""
        self._advance(step)
        self._pose(step)

    def see(self, step: int) -> None:
        """The same for an image of a step."""
        self._advance(step)
        self._see(step)

    def _advance(self, step: int) -> None:
        if self._ended:
            raise RecordingError("an event follows the end of the session")
        if not BEFORE_ALL_STEPS <= step < 2**31:
            raise RecordingError(f"step is {step}; accepted: an integer from {BEFORE_ALL_STEPS}")
        if step < self.step:
            raise RecordingError(f"an event of step {step} follows one of step {self.step}")
        self.step = step

    def _see(self, step: int) -> None:
        if not self.has_rig:
            raise RecordingError(f"an image of step {step} has no rig before it")
        if step <= self._probe or step == BEFORE_ALL_STEPS:
            raise RecordingError(f"an image of step {step} does not precede the probe of its step")

    def _pose(self, step: int) -> None:
        if step <= self._posed:
            raise RecordingError(f"step {step} has a second registration problem")
        self._posed, self._registering = step, True
