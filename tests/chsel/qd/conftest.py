"""What several tests of the library share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import pytest

from chsel.qd import emitter_kernels as kernels
from chsel.qd.emitters import SEARCHES


@pytest.fixture(scope="module")
def searches_around() -> Iterator[Callable[..., None]]:
    """Compiles the searches, as they are, around other functions instead of those of poses."""
    with pytest.MonkeyPatch.context() as patch:

        def around(*functions: Any) -> None:
            for function in functions:
                patch.setattr(kernels, function.__name__, function)
            for name in SEARCHES:
                loop: Any = getattr(kernels, name)
                patch.setattr(kernels, name, numba.njit(error_model="numpy")(loop.py_func))

        yield around
