"""What cannot be evaluated."""

from __future__ import annotations

from chsel.errors import ChselError


class EvaluationError(ChselError):
    """A plausible set cannot be made, written or read, or does not belong to a problem."""
