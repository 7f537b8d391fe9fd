"""Threads that compute otherwise than IEEE 754 specifies."""

from __future__ import annotations

import ctypes
import platform

import numpy as np
import pytest

import chsel
from chsel.errors import EngineError
from chsel.numerics.threads import require_ieee_arithmetic
from tests.chsel.samples import ball_grid

# fesetround's argument, from the C library's <fenv.h>
MODES = {
    "x86_64": {"down": 0x400, "up": 0x800, "towards zero": 0xC00},
    "aarch64": {"down": 0x800000, "up": 0x400000, "towards zero": 0xC00000},
}.get(platform.machine(), {})
NEAREST = 0


@pytest.mark.skipif(not MODES or platform.system() != "Linux", reason="fesetround's values differ")
@pytest.mark.parametrize("mode", ["down", "up", "towards zero"])
def test_a_thread_that_rounds_otherwise_is_refused(mode: str) -> None:
    require_ieee_arithmetic()
    library = ctypes.CDLL(None)
    assert library.fesetround(MODES[mode]) == 0
    try:
        with pytest.raises(EngineError, match="does not round to the nearest number"):
            require_ieee_arithmetic()
    finally:
        library.fesetround(NEAREST)
    require_ieee_arithmetic()


@pytest.mark.skipif(not MODES or platform.system() != "Linux", reason="fesetround's values differ")
def test_no_registration_runs_with_another_rounding() -> None:
    ball = ball_grid(0.025, 0.01, 4)
    points = {"surface": np.array([[0.025, 0.0, 0.0]]), "free": np.array([[0.1, 0.0, 0.0]])}
    settings = {"descent": {"restarts": 1, "iterations": 1}, "emitter": {"iterations": 1}}
    chsel.register(ball, **points, method="chsel", settings=settings)
    library = ctypes.CDLL(None)
    library.fesetround(MODES["up"])
    try:
        with pytest.raises(EngineError, match="does not round"):
            chsel.register(ball, **points, method="chsel", settings=settings)
    finally:
        library.fesetround(NEAREST)
