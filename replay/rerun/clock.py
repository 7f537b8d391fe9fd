"""Where an event stands on the timelines of a Rerun recording."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import rerun as rr

PROBE = "probe"
REGISTRATION = "registration"
ITERATION = "iteration"
TIMELINES = (PROBE, REGISTRATION, ITERATION)


class Clock:
    """Counts iterations on over the whole session, so that no two registrations share a moment.

    On the timeline `probe` a moment is the step of a probe, and shows what was known and found by
    its end. On `iteration` it is a running count of the iterations of all stages of all
    registrations, one extra per registration, so that scrubbing it plays every snapshot in order,
    with the scene of its time. `registration` has the moments of `probe` from the first
    registration on: a viewer opens a timeline at its first moment, and has no setting for another.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._first = 0
        self._now = 0
        self._step = 0
        self._stages: dict[str, int] = {}
        self._registering = False
        self._known = threading.local()  # what the stream has: each thread sets its own

    @property
    def iteration(self) -> int:
        """Iterations of this registration so far, of all stages."""
        return self._now - self._first

    @property
    def moment(self) -> int:
        """The present one on the timeline of iterations."""
        return self._now

    @property
    def registering(self) -> bool:
        """Whether the first registration has begun, with it the timeline of registrations."""
        return self._registering

    def set_probe(self, step: int) -> None:
        """All that is logged from here on belongs to probe `step`."""
        self._step = step
        self._set()

    def tick(self) -> None:
        """A moment passes between two registrations, with something of its own to see."""
        self._now += 1
        self._set()

    @contextmanager
    def beginning_of_registrations(self) -> Iterator[None]:
        """What is logged in the block is on the timeline of registrations alone, as its first."""
        self._registering = True
        self._stream.reset_time()
        self._known.moments = {}
        self._stream.set_time(REGISTRATION, sequence=self._step)
        try:
            yield
        finally:
            self._set()

    def start_registration(self) -> None:
        """A registration starts: one moment after all that was before."""
        self._now += 1
        self._first = self._now
        self._stages = {}
        self._set()

    def advance(self, stage: str, iteration: int) -> None:
        """A stage of this registration has done `iteration` iterations; stages come in turn."""
        start = self._stages.setdefault(stage, self._now)
        self._now = max(self._now, start + iteration)
        self._set()

    def _set(self) -> None:
        moments = {PROBE: self._step, ITERATION: self._now}
        if self._registering:
            moments[REGISTRATION] = self._step
        before = getattr(self._known, "moments", {})
        for timeline, moment in moments.items():
            if before.get(timeline) != moment:
                self._stream.set_time(timeline, sequence=moment)
        self._known.moments = moments
