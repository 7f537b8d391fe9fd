"""The random numbers of numpy's Philox generator, from any place in a stream, inside of kernels.

Each block of four 64-bit words follows from its number alone (Salmon et al., 2011, "Parallel Random
Numbers: As Easy as 1, 2, 3"), so that threads draw what they need, and no draws are stored.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types

from chsel.numerics.compiler import inner, leaf

_intrinsic: Any = extending.intrinsic
_ROUNDS = 10
_PER_BLOCK = 8  # 32-bit numbers
_FACTORS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_KEY_STEPS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_NONE, _ONE = np.uint64(0), np.uint64(1)
_LOW, _HIGH = np.uint64(8), np.uint64(40)  # bits below the upper 24 of either half of a word
_MASK = np.uint64(2**24 - 1)
_UNIT = np.float32(2.0**-24)


class Stream(NamedTuple):
    """The key of a stream."""

    low: Any  # uint64
    high: Any  # uint64


@_intrinsic
def _product(context: Any, a: Any, b: Any) -> Any:
    """The upper and the lower word of a product of two 64-bit words."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide, word = ir.IntType(128), ir.IntType(64)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        upper = builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), word)
        parts = [upper, builder.trunc(product, word)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(types.uint64, 2)(types.uint64, types.uint64), generate


@leaf
def _block(stream, number):
    """The four words of a block by its number, from 0."""
    a, b, c, d = np.uint64(number) + _ONE, _NONE, _NONE, _NONE
    low, high = stream.low, stream.high
    for _ in range(_ROUNDS):
        p, q = _product(_FACTORS[0], a)
        r, s = _product(_FACTORS[1], c)
        a, b, c, d = r ^ b ^ low, s, p ^ d ^ high, q
        low, high = low + _KEY_STEPS[0], high + _KEY_STEPS[1]
    return a, b, c, d


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
        place = at + n * _PER_BLOCK
        _put(a, out, place)
        _put(b, out, place + 2)
        _put(c, out, place + 4)
        _put(d, out, place + 6)
    if skipped > 0:
        for n in range(at, at + count):
            out[n] = out[n + skipped]
