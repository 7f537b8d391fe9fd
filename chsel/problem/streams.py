"""Named, counter-based random streams: the only source of randomness."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types
from numpy.typing import ArrayLike

from chsel.errors import SettingError, quoted
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.elementary import logs, sines_cosines

LAST_STEP = 2**32 - 1  # of a session; random streams distinguish no more steps


class Purpose(IntEnum):
    """Uses of random numbers. Recordings depend on the values: never renumber them."""

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
    PUSHES = 20
    GRASPS = 21


@dataclass(frozen=True)
class StreamKey:
    """Key of all random streams of one registration."""

    seed: int  # of the session, 64 bits
    step: int  # of the session, 32 bits

    def __post_init__(self) -> None:
        for name, bits in (("seed", 64), ("step", 32)):
            value = getattr(self, name)
            is_integer = isinstance(value, Integral) and not isinstance(value, bool)
            if not is_integer or not 0 <= value < 1 << bits:
                raise SettingError(
                    f"{name} is {quoted(value)}; accepted: an integer from 0 to 2**{bits} - 1"
                )
            object.__setattr__(self, name, int(value))

    def stream(self, purpose: Purpose, index: int = 0) -> np.random.Generator:
        """Return the Philox stream of one purpose; `index` tells repetitions in a step apart."""
        key = (self._word(purpose, index) << 64) | self.seed
        return np.random.Generator(np.random.Philox(key=key))

    def kernel_stream(self, purpose: Purpose, index: int = 0) -> Stream:
        """Return the stream for kernels, which draw from it by `fill_uniforms`."""
        return Stream(np.uint64(self.seed), np.uint64(self._word(purpose, index)))

    def _word(self, purpose: Purpose, index: int) -> int:
        return (self.step << 32) | (int(purpose) << 20) | index


def uniforms(
    stream: np.random.Generator,
    lower: ArrayLike,
    *,
    upper: ArrayLike,
    shape: int | tuple[int, ...],
) -> FloatArray:
    """Return numbers of a shape, uniform in [lower, upper)."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    return lower + (upper - lower) * stream.random(shape)


def normals(stream: np.random.Generator, shape: int | tuple[int, ...]) -> FloatArray:
    """Return standard normal numbers of a shape, in C order (Box and Muller).

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


_intrinsic: Any = extending.intrinsic
_ROUNDS = 10
_PER_BLOCK = 8  # 32-bit numbers
_FACTORS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_KEY_STEPS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_NONE, _ONE = np.uint64(0), np.uint64(1)
_LOW, _HIGH = np.uint64(8), np.uint64(40)  # bits below the upper 24 of either half of a word
_MASK = np.uint64(2**24 - 1)
_UNIT = np.float32(2.0**-24)
_SHARE = 2.0**-24


class Stream(NamedTuple):
    """The key of a stream."""

    low: Any  # uint64
    high: Any  # uint64


@_intrinsic
def _product(context: Any, a: Any, b: Any) -> Any:
    """Return the upper and the lower word of a product of two 64-bit words."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide, word = ir.IntType(128), ir.IntType(64)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        upper = builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), word)
        parts = [upper, builder.trunc(product, word)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(types.uint64, 2)(types.uint64, types.uint64), generate


@leaf
def _block(stream, number):
    """Return the four words of a block by its number, from 0."""
    a, b, c, d = np.uint64(number) + _ONE, _NONE, _NONE, _NONE
    low, high = stream.low, stream.high
    for _ in range(_ROUNDS):
        p, q = _product(_FACTORS[0], a)
        r, s = _product(_FACTORS[1], c)
        a, b, c, d = r ^ b ^ low, s, p ^ d ^ high, q
        low, high = low + _KEY_STEPS[0], high + _KEY_STEPS[1]
    return a, b, c, d


@leaf
def uniforms_of_block(stream, number):
    """Return the eight numbers of [0, 1), multiples of 2^-24, of a block by its number, from 0.

    They are those of `Generator.random` for float32, from 8 `number` on.
    """
    a, b, c, d = _block(stream, number)
    p, q = _shares(a)
    r, s = _shares(b)
    t, u = _shares(c)
    v, w = _shares(d)
    return p, q, r, s, t, u, v, w


@leaf
def _shares(word):
    """Return the numbers of [0, 1) that the halves of a word make."""
    low = np.float64(np.int64((word >> _LOW) & _MASK)) * _SHARE
    return low, np.float64(np.int64(word >> _HIGH)) * _SHARE


@leaf
def _put(word, out, at):
    """Set two numbers of [0, 1), the multiples of 2^-24 that the halves of a word make."""
    out[at] = np.float32(np.int32((word >> _LOW) & _MASK)) * _UNIT
    out[at + 1] = np.float32(np.int32(word >> _HIGH)) * _UNIT


@inner
def fill_uniforms(stream, first, out, at, count):
    """Fill out (S,) float32, from `at`, with the numbers from `first` on of a stream.

    They are those of `Generator.random` for float32. S must have room for 14 numbers more, which
    are changed, too.
    """
    number, skipped = first // _PER_BLOCK, first % _PER_BLOCK
    for n in range((skipped + count + _PER_BLOCK - 1) // _PER_BLOCK):
        a, b, c, d = _block(stream, number + n)
        to = at + n * _PER_BLOCK
        _put(a, out, to)
        _put(b, out, to + 2)
        _put(c, out, to + 4)
        _put(d, out, to + 6)
    if skipped > 0:
        for n in range(at, at + count):
            out[n] = out[n + skipped]
