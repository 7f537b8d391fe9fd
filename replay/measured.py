"""Whether the numbers that are recorded about a result follow from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from chsel.methods import trust_by
from chsel.methods.method import Method
from chsel.plausible.pose_metrics import result_numbers
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from replay.events import Measured, SessionStarted
from replay.lost_attachment import is_lost
from replay.registration import symmetry_for_errors

RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""How far a number may be from the recorded one: libraries beneath may round otherwise."""

ERRORS = 1e-4
"""m or rad: how far errors to the true pose may be, as symmetries depend on LAPACK and libigl."""


def measured_differences(
    start: SessionStarted,
    problem: RegistrationProblem,
    hypotheses: Hypotheses,
    recorded: Sequence[Measured],
    method: Method,
) -> list[str]:
    """Lines about measured values of one registration that are not those of its result.

    method: that of the recording. Older recordings do not say how far to trust a result.
    """
    if len(recorded) != 1:
        return [f"there are {len(recorded)} messages of measured values; accepted: one"]
    values = recorded[0].values
    symmetry = symmetry_for_errors(start)
    trust = trust_by(method, problem, hypotheses)
    if trust is not None and not values.keys() & trust.numbers.keys():
        trust = None
    again = result_numbers(hypotheses, problem, start.world_from_object, symmetry, trust)
    return [
        f"measured {name}: {_shown(values, name)} recorded, {_shown(again, name)} computed"
        for name in sorted({*values, *again})
        if not _close(values.get(name), again.get(name), name)
        and not (name.endswith("_error") and is_lost(start.mesh))  # modulo the shape's symmetries
    ]


def _close(recorded: float | None, computed: float | None, name: str) -> bool:
    if recorded is None or computed is None:
        return False
    if math.isnan(recorded) or math.isnan(computed):
        return math.isnan(recorded) and math.isnan(computed)
    absolute = ERRORS if name.endswith("_error") else ABSOLUTE
    return math.isclose(recorded, computed, rel_tol=RELATIVE, abs_tol=absolute)


def _shown(values: Mapping[str, float], name: str) -> str:
    return repr(values[name]) if name in values else "not"
