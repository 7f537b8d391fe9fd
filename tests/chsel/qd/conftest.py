"""The compiled searches of quality diversity, around another cost than that of poses."""

from typing import Any

import numba
import pytest

from chsel.numerics.pose_tuples import all_finite
from chsel.qd import emitters


@pytest.fixture(scope="module")
def searches_around():
    """Compiles the searches, as they are, around another cost instead of that of poses."""
    with pytest.MonkeyPatch.context() as patch:

        def around(cost_of, cost_and_gradient_of):
            patch.setattr(emitters, "cost_and_gradient_of", cost_and_gradient_of)
            patch.setattr(emitters, "costs_of", _one_by_one(cost_of))
            for name in ("mega_iterations", "me_iterations"):
                loop: Any = getattr(emitters, name)
                patch.setattr(emitters, name, numba.njit(error_model="numpy")(loop.py_func))

        yield around


def _one_by_one(cost_of):
    """What fills the costs of several vectors, of what returns that of one."""

    @numba.njit
    def costs_of(model, space, vectors, costs, work):
        for n in range(len(vectors)):
            if all_finite(vectors[n]):
                costs[n] = cost_of(model, space, vectors[n], work)

    return costs_of
