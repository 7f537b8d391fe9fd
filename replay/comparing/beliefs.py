"""Beliefs of recorded results, computed from the results themselves."""

from __future__ import annotations

from dataclasses import replace

from chsel.belief import PoseBelief
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.session.judging import noise_of, trust_by
from replay.comparing.choices import recorded_method
from replay.mcap.reader import Recording


class BeliefSequence:
    """Beliefs after the results of one session, in their order; modes keep their numbers."""

    def __init__(self, recording: Recording) -> None:
        """Raises RecordingError if the recording does not have the settings of its method."""
        self._method = recorded_method(recording).build()
        self._start = recording.start
        self._last: PoseBelief | None = None

    def after(self, problem: RegistrationProblem, found: Hypotheses) -> PoseBelief | None:
        """Return the belief after one more result; None for one without a pose."""
        trust = trust_by(self._method, problem, hypotheses=found)
        if trust is None:
            return None
        self._last = PoseBelief(
            self._start.sdf,
            replace(found, trust=trust),
            symmetry=symmetry_of(self._start.sdf, self._start.mesh),
            previous=self._last,
            problem=problem,
            noise=noise_of(self._method),
        )
        return self._last
