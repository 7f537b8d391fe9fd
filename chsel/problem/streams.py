"""Named, counter-based random streams: the only source of randomness."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from chsel.errors import SettingError, quoted
from chsel.numerics.arrays import FloatArray
from chsel.numerics.elementary import logs, sines_cosines
from chsel.numerics.philox import Stream

LAST_STEP = 2**32 - 1  # of a session; random streams distinguish no more steps


class Purpose(IntEnum):
    """What random numbers are used for. Recordings depend on the values: never renumber them."""

    INITIAL_POSES = 1
    UPDATE_NOISE = 2
    REFINEMENT = 3
    EMITTER = 4
    RESTART = 5
    RESAMPLE = 6
    MESH_SAMPLES = 7
    CONTROL_NOISE = 8
    SENSOR_NOISE = 9
    ICP_SURFACE = 10
    CMA_ES = 11
    PLAUSIBLE_ROTATIONS = 12
    METRIC_POINTS = 13
    CONTACT_POINTS = 14
    ANCHORS = 15
    WALKS = 16
    FAULTS = 17
    PRIOR_BELIEF = 18
    POLICY = 19


@dataclass(frozen=True)
class StreamKey:
    """Key of all random streams of one registration."""

    seed: int  # of the session, 64 bits
    step: int  # of the session, 32 bits

    def __post_init__(self) -> None:
        for name, bits in (("seed", 64), ("step", 32)):
            value = getattr(self, name)
            is_integer = isinstance(value, Integral) and not isinstance(value, bool)
            if not is_integer or not 0 <= value < 2**bits:
                raise SettingError(
                    f"{name} is {quoted(value)}; accepted: an integer from 0 to 2**{bits} - 1"
                )
            object.__setattr__(self, name, int(value))

    def stream(self, purpose: Purpose, index: int = 0) -> np.random.Generator:
        """The Philox stream of one purpose; `index` distinguishes repetitions within a step."""
        key = (self._word(purpose, index) << 64) | self.seed
        return np.random.Generator(np.random.Philox(key=key))

    def kernel_stream(self, purpose: Purpose, index: int = 0) -> Stream:
        """The same stream for kernels, which draw from it by `fill_uniforms`."""
        return Stream(np.uint64(self.seed), np.uint64(self._word(purpose, index)))

    def _word(self, purpose: Purpose, index: int) -> int:
        return (self.step << 32) | (int(purpose) << 20) | index


def uniforms(
    stream: np.random.Generator,
    lower: ArrayLike,
    upper: ArrayLike,
    shape: int | tuple[int, ...],
) -> FloatArray:
    """Numbers of a shape, uniform in [lower, upper)."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    return lower + (upper - lower) * stream.random(shape)


def normals(stream: np.random.Generator, shape: int | tuple[int, ...]) -> FloatArray:
    """Standard normal numbers of a shape, in C order (Box and Muller).

    Numbers 2i and 2i + 1 are r cos(a) and r sin(a), with r = sqrt(-2 ln(1 - u)) and a = 2 pi v,
    where u and v are the uniform numbers 2i and 2i + 1 of the stream, in [0, 1). The last sine is
    omitted for an odd count. No magnitude exceeds 8.6. Unlike numpy's, they depend only on the
    stream's raw output, not on numpy's version or the C library.
    """
    count = int(np.prod(shape))
    u, v = stream.random(((count + 1) // 2, 2)).T
    radius = np.sqrt(-2.0 * logs(1.0 - u))
    sine, cosine = sines_cosines(2.0 * np.pi * v)
    pairs = np.stack([radius * cosine, radius * sine], axis=1)
    return pairs.reshape(-1)[:count].reshape(shape)
