"""A warning of a session, as its summary has it."""

from __future__ import annotations

from dataclasses import dataclass

FROM_SESSION = "session"
"""The code of warnings that the session itself gives."""


@dataclass(frozen=True)
class StepWarning:
    """What a person should know about the input.

    step: the probe at which it first holds. code: the kind of warning. text: one line.
    """

    step: int
    code: str
    text: str
