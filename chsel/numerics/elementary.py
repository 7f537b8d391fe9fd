"""exp, log, sine and cosine, and arctangent with the same bits on every machine.

Each reduces its argument to a small interval without loss, sums a Taylor series there, and adds
the large part last, with the rounding errors of the reduction as a correction. The first neglected
term of a series is below 0.1 ulp; errors against mpmath are below 0.85 ulp. The C library is not
called: its last bits depend on its version and on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, leaf, spliced

_HALF_PI = 1.5707963267948966
_HALF_PI_TAIL = 6.123233995736766e-17  # pi/2 - _HALF_PI
_TURN = 4.0 * _HALF_PI

# pi/2 and ln 2 in parts that end in enough zeros for n times a part to be exact, for n < 2^20 and
# n < 2^11; the last part is rounded.
_HALF_PI_PARTS = (
    float.fromhex("0x1.921fb544p+0"),
    float.fromhex("0x1.0b4611a6p-34"),
    float.fromhex("0x1.3198a2e0p-69"),
    float.fromhex("0x1.b839a252049c1p-104"),
)
_LARGEST_REDUCED = 2.0**20
_LN_2_HIGH = float.fromhex("0x1.62e42fefa38p-1")
_LN_2_LOW = float.fromhex("0x1.ef35793c7673p-45")


def _alternating(k: int) -> float:
    return 1.0 - 2.0 * (k % 2)


_EXP = tuple(1.0 / factorial(n) for n in range(13, 1, -1))  # of r^(n - 2)
_SINE = tuple(_alternating(k) / factorial(2 * k + 1) for k in range(8, 0, -1))  # of r^(2k - 2)
_COSINE = tuple(_alternating(k) / factorial(2 * k) for k in range(8, 1, -1))  # of r^(2k - 4)
_LOG = tuple(2.0 / (2 * k + 1) for k in range(10, 0, -1))  # of s^(2k - 2)
_ARCTANGENT = tuple(_alternating(k) / (2 * k + 1) for k in range(13, 0, -1))  # of r^(2k - 2)
_ARCTANGENT_HALF = 0.4636476090008061
_ARCTANGENT_HALF_TAIL = 2.2698777452961687e-17

_MANTISSA = (1 << 52) - 1
_HEAD = ~((1 << 27) - 1)


@compiled
def _series(coefficients: tuple[float, ...], x: float) -> float:
    """Return the polynomial with these coefficients, highest power first (Horner)."""
    total = 0.0
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


@compiled
def _bits(x: float) -> np.int64:
    return np.float64(x).view(np.int64)


@compiled
def _from_bits(bits: np.int64) -> float:
    return np.int64(bits).view(np.float64)


@compiled
def _power_of_2(n: np.int64) -> float:
    return _from_bits((n + 1023) << 52)


@compiled
def exp(x: float) -> float:
    """Return e^x, from x = k ln 2 + r with |r| <= ln(2) / 2; rounded once where it is subnormal."""
    if x != x or x > 710.0:
        return x + np.inf
    if x < -746.0:
        return 0.0
    k = np.rint(x * 1.4426950408889634)
    high = x - k * _LN_2_HIGH
    low = k * _LN_2_LOW
    r = high - low
    tail = (high - r) - low
    head = 1.0 + r
    y = head + (((1.0 - head) + r) + (r * r * _series(_EXP, r) + tail))
    half = np.int64(np.floor(0.5 * k))  # 2^k may overflow where y 2^k does not
    return y * _power_of_2(half) * _power_of_2(np.int64(k) - half)


@leaf
def exp_in_lanes(x: float) -> float:
    """Return e^x from -700 to 700, the bits of `exp`, without a branch: loops can be vectorised."""
    k = np.rint(x * 1.4426950408889634)
    high = x - k * _LN_2_HIGH
    low = k * _LN_2_LOW
    r = high - low
    tail = (high - r) - low
    head = 1.0 + r
    # A loop over the coefficients is not made into vector instructions.
    c13, c12, c11, c10, c9, c8, c7, c6, c5, c4, c3, c2 = _EXP
    upper = (((((c13 * r + c12) * r + c11) * r + c10) * r + c9) * r + c8) * r + c7
    series = ((((upper * r + c6) * r + c5) * r + c4) * r + c3) * r + c2
    y = head + (((1.0 - head) + r) + (r * r * series + tail))
    return y * _power_of_2(np.int64(k))


@compiled
def log(x: float) -> float:
    """Return ln x, from x = 2^k m with sqrt(1/2) <= m < sqrt(2); NaN below 0."""
    if x != x or x < 0.0:
        return np.nan
    if x == 0.0:
        return -np.inf
    if x == np.inf:
        return x
    shift = 0
    if x < 2.2250738585072014e-308:
        x *= 2.0**54
        shift = 54
    bits = _bits(x)
    k = (bits >> 52) - 1023 - shift
    m = _from_bits((bits & _MANTISSA) | (1023 << 52))
    if m > 1.4142135623730951:
        m *= 0.5
        k += 1
    f = m - 1.0
    s = f / (2.0 + f)  # so that 2 s = f - s f, whose first term is exact
    h = 0.5 * f * f
    rest = s * (h + s * s * _series(_LOG, s * s))
    return k * _LN_2_HIGH - ((h - (rest + k * _LN_2_LOW)) - f)


@compiled
def _reduced(x: float) -> tuple[float, float, np.int64]:
    """Return r + tail = x - n pi/2 within pi/4 (Cody and Waite), and n, for |x| below 2^20."""
    n = np.rint(x * 0.6366197723675814)
    first = x - n * _HALF_PI_PARTS[0]
    second = first - n * _HALF_PI_PARTS[1]
    error = _difference_error(first, n * _HALF_PI_PARTS[1], second)
    third = second - n * _HALF_PI_PARTS[2]
    error += _difference_error(second, n * _HALF_PI_PARTS[2], third)
    error -= n * _HALF_PI_PARTS[3]
    r = third + error
    return r, (third - r) + error, np.int64(n)


@compiled
def _difference_error(a: float, b: float, difference: float) -> float:
    """Return (a - b) - difference, exactly, for the rounded difference of a and b (Knuth)."""
    taken = a - difference
    return (a - (difference + taken)) + (taken - b)


@compiled
def _remainder(x: float) -> float:
    """Return x modulo _TURN for positive x, exactly: long division by exact differences."""
    step = _TURN
    while step <= 0.5 * x:
        step *= 2.0
    while step >= _TURN:
        if x >= step:
            x -= step
        step *= 0.5
    return x


@compiled
def sine_cosine(x: float) -> tuple[float, float]:
    """Return sin x and cos x of radians; NaN for infinity.

    From 2^20 on, x is taken modulo the double nearest to 2 pi, an error below 4e-17 |x|, which is
    less than the rounding of x itself.
    """
    size = abs(x)
    if not size < np.inf:
        return np.nan, np.nan
    if size < 2.0**-27:
        return x, 1.0
    if size >= _LARGEST_REDUCED:
        x = _remainder(size) if x > 0.0 else -_remainder(size)
    r, tail, n = _reduced(x)
    z = r * r
    half = 0.5 * z
    sine = r + (r * z * _series(_SINE, z) + tail * (1.0 - half))
    head = 1.0 - half
    cosine = head + (((1.0 - head) - half) + (z * z * _series(_COSINE, z) - r * tail))
    quadrant = n & 3
    if quadrant == 0:
        return sine, cosine
    if quadrant == 1:
        return cosine, -sine
    if quadrant == 2:
        return -sine, -cosine
    return -cosine, sine


@spliced
def sine_cosine_of_share(share: float) -> tuple[float, float]:
    """Return sine and cosine of a share of a turn, 0 to 1, to 1e-15, without a branch."""
    quarters = np.rint(4.0 * share)
    r = (4.0 * share - quarters) * _HALF_PI
    z = r * r
    # A loop over the coefficients is not made into vector instructions.
    c9, c8, c7, c6, c5, c4, c3, c2 = _SINE
    sine = r + r * z * (
        ((((((c9 * z + c8) * z + c7) * z + c6) * z + c5) * z + c4) * z + c3) * z + c2
    )
    d8, d7, d6, d5, d4, d3, d2 = _COSINE
    fourth = (((((d8 * z + d7) * z + d6) * z + d5) * z + d4) * z + d3) * z + d2
    cosine = (1.0 - 0.5 * z) + z * z * fourth
    odd = (quarters == 1.0) | (quarters == 3.0)
    below = (quarters == 2.0) | (quarters == 3.0)
    left = (quarters == 1.0) | (quarters == 2.0)
    first = cosine if odd else sine
    second = sine if odd else cosine
    return -first if below else first, -second if left else second


@compiled
def _quotient(n: float, d: float, d_tail: float) -> tuple[float, float]:
    """Return q + tail = n / (d + d_tail), from the remainder by products of half-length factors."""
    q = n / d
    q_head, d_head = _from_bits(_bits(q) & _HEAD), _from_bits(_bits(d) & _HEAD)
    q_rest, d_rest = q - q_head, d - d_head
    left = ((n - q_head * d_head) - q_head * d_rest) - q_rest * d_head
    return q, ((left - q_rest * d_rest) - q * d_tail) / d


@compiled
def _arctangent_of_ratio(small: float, big: float) -> tuple[float, float]:
    """Return angle + tail = arctan(small / big) for 0 <= small <= big, in [0, pi/4].

    arctan(t) = arctan(c) + arctan((t - c) / (1 + c t)) with c the nearest of 0, 1/2 and 1.
    """
    q = small / big
    if q < 2.0**-30:
        return q, 0.0
    scale = 2.0**600 if big < 1.0 else 2.0**-400
    if 1e-100 < big < 1e100:
        scale = 1.0
    small, big = small * scale, big * scale
    c = 0.0
    base = 0.0
    base_tail = 0.0
    if q > 0.75:
        c = 1.0
        base = 0.5 * _HALF_PI
        base_tail = 0.5 * _HALF_PI_TAIL
    elif q > 0.25:
        c = 0.5
        base = _ARCTANGENT_HALF
        base_tail = _ARCTANGENT_HALF_TAIL
    d = big + c * small
    r, r_tail = _quotient(small - c * big, d, (big - d) + c * small)
    z = r * r
    angle = base + r
    tail = (base - angle) + r
    return angle, tail + (r * z * _series(_ARCTANGENT, z) + (base_tail + r_tail * (1.0 - z)))


@compiled
def arctangent(y: float, x: float) -> float:
    """Return the angle of (x, y) in [-pi, pi] radians; signed zeros and infinities as in C."""
    if x != x or y != y:
        return np.nan
    high, wide = abs(y), abs(x)
    if high == wide and (high == 0.0 or high == np.inf):
        high = 0.0 if high == 0.0 else 1.0
        wide = 1.0
    steep = high > wide
    angle, tail = _arctangent_of_ratio(min(high, wide), max(high, wide))
    left = _bits(x) < 0
    base, base_tail = 0.0, 0.0
    if steep:
        base, base_tail = _HALF_PI, _HALF_PI_TAIL
    elif left:
        base, base_tail = 2.0 * _HALF_PI, 2.0 * _HALF_PI_TAIL
    if steep != left:
        angle, tail = -angle, -tail
    total = base + angle
    total += ((base - total) + angle) + (base_tail + tail)
    return -total if _bits(y) < 0 else total


@compiled
def _fill_sines_cosines(x: FloatArray, sine: FloatArray, cosine: FloatArray) -> None:
    for i in range(x.size):
        sine[i], cosine[i] = sine_cosine(x[i])


@compiled
def _fill_exps(x: FloatArray, out: FloatArray) -> None:
    for i in range(x.size):
        out[i] = exp(x[i])


@compiled
def _fill_logs(x: FloatArray, out: FloatArray) -> None:
    for i in range(x.size):
        out[i] = log(x[i])


@compiled
def _fill_arctangents(y: FloatArray, x: FloatArray, out: FloatArray) -> None:
    for i in range(x.size):
        out[i] = arctangent(y[i], x[i])


def _filled(
    fill: Callable[..., None], *arguments: FloatArray | float, outputs: int = 1
) -> list[FloatArray]:
    """Return the arrays that a kernel fills, of the shape that its arguments broadcast to."""
    arrays = np.broadcast_arrays(*(np.asarray(each, dtype=np.float64) for each in arguments))
    out = [np.empty(arrays[0].size) for _ in range(outputs)]
    fill(*(array.flatten() for array in arrays), *out)
    return [each.reshape(arrays[0].shape) for each in out]


def sines_cosines(x: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Return sin x and cos x, each of the shape of x."""
    sine, cosine = _filled(_fill_sines_cosines, x, outputs=2)
    return sine, cosine


def exps(x: FloatArray | float) -> FloatArray:
    """Return e^x, of the shape of x."""
    return _filled(_fill_exps, x)[0]


def logs(x: FloatArray | float) -> FloatArray:
    """Return ln x, of the shape of x."""
    return _filled(_fill_logs, x)[0]


def arctangents(y: FloatArray | float, x: FloatArray | float) -> FloatArray:
    """Return the angles of the points (x, y), of the shape that x and y broadcast to."""
    return _filled(_fill_arctangents, y, x)[0]
