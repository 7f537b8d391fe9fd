"""Ascent of the inner product of two labelled clouds (CVO; Zhang et al., 2021), start by start.

Of the cloud in the object frame only its fields are left: f(p) = sum_j a(p, z_j), one per class.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.methods.cvo.field_kernels import ClassTerm, moments_at, sum_at
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import sine_cosine
from chsel.numerics.pose_tuples import composed, pose_at, turned_back

STEPS = 16
_PATIENCE = 5
_REFINEMENTS = 3
_NEAR = 0.05  # steps count as equally long if they differ by less than this fraction


class Product(NamedTuple):
    """F(X) = sum over classes of W sum_i f(R x_i + t)."""

    free: ClassTerm
    cubes: ClassTerm  # centres of cubes of free points
    surface: ClassTerm


class Ascent(NamedTuple):
    """How to climb."""

    steps: FloatArray  # (16,), tau, ascending
    c: float  # scale of the flow's rotation
    d: float  # and of its translation
    stop_below: float  # relative gain of F that counts as none; negative: every gain counts


class Climbers(NamedTuple):
    """The starts of an ascent and how far they are; `climb` changes them in place."""

    poses: FloatArray  # (B, 12)
    value: FloatArray  # (B,), F
    step: IntArray  # (B,), index of the last step's length
    stalled: IntArray  # (B,), iterations in a row that gained nothing
    done: BoolArray  # (B,)
    moved: BoolArray  # (B,)


def climbers_at(poses: FloatArray, value: FloatArray) -> Climbers:
    """Climbers at copies of poses (B, 12) with their F (B,), before the first step."""
    counts = np.zeros((2, len(poses)), dtype=np.int64)
    flags = np.zeros((2, len(poses)), dtype=np.bool_)
    return Climbers(poses.copy(), value.copy(), *counts, *flags)


@compiled
def products(product, poses, out, first, last, scratch):
    """Fill out (B,) with F at poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = _product_at(product, pose_at(poses, n), scratch)


@compiled
def climb(product, ascent, climbers, iterations, first, last, scratch):
    """Move climbers uphill for some iterations, those from `first` to before `last`."""
    for n in range(first, last):
        for _ in range(iterations):
            if not climbers.done[n]:
                pose = pose_at(climbers.poses, n)
                xi, slope = _direction(product, ascent, pose, scratch)
                if slope > 0.0:
                    _step(product, ascent, pose, xi, slope, climbers, n, scratch)
                else:
                    climbers.done[n] = True


@inner
def _direction(product, ascent, pose, scratch):
    """The flow xi = (omega, u) as a unit vector, and the slope of F along it; 0 without overlap.

    omega = 1/c sum x_i x h_i, u = 1/d sum h_i.
    """
    flow = flow_at(product, pose, scratch)
    a, b, c = flow[1] / ascent.c, flow[2] / ascent.c, flow[3] / ascent.c
    d, e, f = flow[4] / ascent.d, flow[5] / ascent.d, flow[6] / ascent.d
    size = np.sqrt(a * a + b * b + c * c + d * d + e * e + f * f)
    if not 0.0 < size < np.inf:
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0
    xi = a / size, b / size, c / size, d / size, e / size, f / size
    slope = 0.0
    for i in range(6):
        slope += xi[i] * flow[i + 1]
    return xi, slope


@inner
def _step(product, ascent, pose, xi, slope, climbers, n, scratch):
    """Move climber n by the best step found along the flow, if any is uphill.

    From the last step's length on: longer while F rises, or shorter until it has risen; then where
    polynomials are highest that have F and its slope at 0, and F at the lengths tried.
    """
    steps, before = ascent.steps, climbers.value[n]
    least, most = steps[0] / 1024.0, steps[STEPS - 1]
    k = climbers.step[n]
    tau, other, at_other = steps[k], 0.0, 0.0
    value = _product_at(product, _moved_along(pose, xi, tau), scratch)
    vertex = _vertex(tau, value - before, slope)
    while value > before and vertex > tau and k + 1 < STEPS:
        beyond = _product_at(product, _moved_along(pose, xi, steps[k + 1]), scratch)
        if not beyond > value:
            other, at_other = steps[k + 1], beyond
            break
        other, at_other = tau, value
        k, tau, value = k + 1, steps[k + 1], beyond
        vertex = _vertex(tau, value - before, slope)
    while value <= before and tau > least:
        other, at_other = tau, value
        tau = max(min(vertex, 0.5 * tau), 0.1 * tau)
        value = _product_at(product, _moved_along(pose, xi, tau), scratch)
        vertex = _vertex(tau, value - before, slope)
    if value <= before:
        climbers.done[n] = True
        return
    ahead = vertex
    if other > 0.0:
        ahead = _crest(tau, value - before, other, at_other - before, slope)
    for _ in range(_REFINEMENTS):
        if not (ahead <= most and abs(ahead - tau) > _NEAR * tau):
            break
        at_ahead = _product_at(product, _moved_along(pose, xi, ahead), scratch)
        if at_ahead > value:
            tau, value, other, at_other = ahead, at_ahead, tau, value
        else:
            other, at_other = ahead, at_ahead
        ahead = _crest(tau, value - before, other, at_other - before, slope)
    reached = _moved_along(pose, xi, tau)
    for i in range(12):
        climbers.poses[n, i] = reached[i]
    while k > 0 and steps[k] > tau:
        k -= 1
    small = value - before <= ascent.stop_below * before
    climbers.value[n], climbers.step[n], climbers.moved[n] = value, k, True
    climbers.stalled[n] = climbers.stalled[n] + 1 if small else 0
    climbers.done[n] = climbers.stalled[n] >= _PATIENCE


@leaf
def _vertex(tau, gain, slope):
    """Where a parabola of that slope at 0 and that gain at tau is highest; infinite if nowhere."""
    bend = (gain / tau - slope) / tau
    return -0.5 * slope / bend if bend < 0.0 else np.inf


@leaf
def _crest(tau, gain, other, other_gain, slope):
    """Where a cubic of that slope at 0 and those gains is highest nearby; infinite if nowhere."""
    near, far = (gain / tau - slope) / tau, (other_gain / other - slope) / other
    third = (far - near) / (other - tau)
    second = near - third * tau
    root = second * second - 3.0 * third * slope
    below = np.sqrt(root) - second if root >= 0.0 else 0.0
    return slope / below if below > 0.0 else np.inf


@leaf
def _moved_along(pose, xi, tau):
    """G Exp(tau xi) of a pose G = (R, t) and a unit vector xi = (omega, u).

    Exp has the rotation I + sin(a) W + (1 - cos(a)) W^2, a = tau |omega|, W the hat of omega /
    |omega|, and the translation tau (u + (1 - cos a)/a W u + (a - sin a)/a W^2 u).
    """
    size = np.sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    angle = tau * size
    inverse = 1.0 / size if size > 0.0 else 0.0
    a, b, c = xi[0] * inverse, xi[1] * inverse, xi[2] * inverse
    sine, cosine = sine_cosine(angle)
    half, _ = sine_cosine(0.5 * angle)
    back = 2.0 * half * half  # 1 - cos, which loses no digit of small angles
    u, v, w = xi[3], xi[4], xi[5]
    p, q, r = b * w - c * v, c * u - a * w, a * v - b * u
    i, j, k = b * r - c * q, c * p - a * r, a * q - b * p
    first = back / angle if angle > 0.0 else 0.0
    second = _rest_of_sine(angle, sine)
    exponential = (
        cosine + back * a * a,
        back * a * b - sine * c,
        back * a * c + sine * b,
        back * a * b + sine * c,
        cosine + back * b * b,
        back * b * c - sine * a,
        back * a * c - sine * b,
        back * b * c + sine * a,
        cosine + back * c * c,
        tau * (u + first * p + second * i),
        tau * (v + first * q + second * j),
        tau * (w + first * r + second * k),
    )
    return composed(pose, exponential)


@leaf
def _rest_of_sine(angle, sine):
    """(a - sin a) / a; by its series where the difference would lose digits."""
    if angle < 0.02:
        square = angle * angle
        return square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0))
    return (angle - sine) / angle


@inner
def _product_at(product, pose, scratch):
    """F at a pose."""
    total = 0.0
    for term in product:
        total += sum_at(term, pose, scratch)
    return total


@inner
def flow_at(product, pose, scratch):
    """F, sum x_i x h_i and sum h_i with h_i = R^T grad f(R x_i + t), in the world."""
    value = x = y = z = p = q = r = 0.0
    for term in product:
        f, gx, gy, gz, a, b, c = moments_at(term, pose, scratch)
        value, x, y, z = value + f, x + gx, y + gy, z + gz
        p, q, r = p + a, q + b, r + c
    # R (x_i x h_i) = (p_i - t) x grad f(p_i)
    p -= pose[10] * z - pose[11] * y
    q -= pose[11] * x - pose[9] * z
    r -= pose[9] * y - pose[10] * x
    return (value, *turned_back(pose, p, q, r), *turned_back(pose, x, y, z))
