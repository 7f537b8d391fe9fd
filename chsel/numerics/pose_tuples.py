"""Poses in kernels: search vectors decoded, gradients pulled back, and points moved, one at a time.

A pose is a tuple of 12: the rotation of object_from_world row by row, then the translation. So is
a gradient by a pose. Tuples of 9 are matrices, row by row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.elementary import sine_cosine

_SHORTEST = 1e-12  # the least length that vectors are divided by

Triple = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Pose = tuple[float, ...]  # of length 12
_NO_MATRIX: Matrix = (0.0,) * 9


class SpaceConstants(NamedTuple):
    """A search space as kernels take it: SE(3), or planar with the plane's constants (SE2Space)."""

    planar: bool = False  # whether it is SE(2)
    axis: Triple = (0.0, 0.0, 0.0)  # a, of unit length
    e_u: Triple = (0.0, 0.0, 0.0)  # unit vector in the plane
    e_v: Triple = (0.0, 0.0, 0.0)  # the other one, across e_u
    resting: Matrix = _NO_MATRIX  # R_0
    turning: Matrix = _NO_MATRIX  # hat(a) R_0
    turning_squared: Matrix = _NO_MATRIX  # hat(a)^2 R_0
    offset: float = 0.0  # o, metres


def matrix_of(rotation: FloatArray) -> Matrix:
    """Return a matrix (3, 3) as nine numbers."""
    a, b, c, d, e, f, g, h, i = (float(value) for value in rotation.reshape(-1))
    return a, b, c, d, e, f, g, h, i


@leaf
def decode(space, x):
    """Return the pose of a search vector."""
    if space.planar:
        return planar_pose(space, x)
    p, q, r, u, v, w = _gram_schmidt(x)[:6]
    return p, q, r, u, v, w, q * w - r * v, r * u - p * w, p * v - q * u, x[6], x[7], x[8]


@leaf
def _gram_schmidt(x):
    """Return two rows made orthonormal (Zhou et al.; Sec. IV-B): b1 and b2, |a1|, b1 . a2, |u|."""
    a = _length(x[0], x[1], x[2])
    p, q, r = x[0] / a, x[1] / a, x[2] / a
    along = p * x[3] + q * x[4] + r * x[5]
    u, v, w = x[3] - along * p, x[4] - along * q, x[5] - along * r
    b = _length(u, v, w)
    return p, q, r, u / b, v / b, w / b, a, along, b


@leaf
def planar_pose(space, x):
    """Return R = Rot(a, theta) R_0 by Rodrigues' formula, t = o a + u e_u + v e_v."""
    sine, cosine = sine_cosine(x[0])
    turn = space.turning
    squared = space.turning_squared
    rest = space.resting
    back = 1.0 - cosine
    return (
        rest[0] + sine * turn[0] + back * squared[0],
        rest[1] + sine * turn[1] + back * squared[1],
        rest[2] + sine * turn[2] + back * squared[2],
        rest[3] + sine * turn[3] + back * squared[3],
        rest[4] + sine * turn[4] + back * squared[4],
        rest[5] + sine * turn[5] + back * squared[5],
        rest[6] + sine * turn[6] + back * squared[6],
        rest[7] + sine * turn[7] + back * squared[7],
        rest[8] + sine * turn[8] + back * squared[8],
        x[1] * space.e_u[0] + x[2] * space.e_v[0] + space.offset * space.axis[0],
        x[1] * space.e_u[1] + x[2] * space.e_v[1] + space.offset * space.axis[1],
        x[1] * space.e_u[2] + x[2] * space.e_v[2] + space.offset * space.axis[2],
    )


@leaf
def pull_back(space, x, by_pose, gradient):
    """Fill the gradient (d,) by the search vector x from the gradient by its pose."""
    if space.planar:
        _pull_back_planar(space, x, by_pose, gradient)
    else:
        _pull_back_spatial(x, by_pose, gradient)


@leaf
def _pull_back_spatial(x, by_pose, gradient):
    """Fill the gradient by b3 = b1 x b2, b2 = u / |u|, u = a2 - (b1 . a2) b1, b1 = a1 / |a1|."""
    p, q, r, u, v, w, a, along, b = _gram_schmidt(x)
    d, e, f = by_pose[6], by_pose[7], by_pose[8]
    p2 = by_pose[3] + (e * r - f * q)
    q2 = by_pose[4] + (f * p - d * r)
    r2 = by_pose[5] + (d * q - e * p)
    p1 = by_pose[0] + (v * f - w * e)
    q1 = by_pose[1] + (w * d - u * f)
    r1 = by_pose[2] + (u * e - v * d)
    inward = p2 * u + q2 * v + r2 * w if b > _SHORTEST else 0.0
    p2, q2, r2 = (p2 - inward * u) / b, (q2 - inward * v) / b, (r2 - inward * w) / b
    by_along = -(p2 * p + q2 * q + r2 * r)
    p1 += by_along * x[3] - along * p2
    q1 += by_along * x[4] - along * q2
    r1 += by_along * x[5] - along * r2
    inward = p1 * p + q1 * q + r1 * r if a > _SHORTEST else 0.0
    gradient[0], gradient[1] = (p1 - inward * p) / a, (q1 - inward * q) / a
    gradient[2] = (r1 - inward * r) / a
    gradient[3], gradient[4] = p2 + by_along * p, q2 + by_along * q
    gradient[5] = r2 + by_along * r
    gradient[6], gradient[7], gradient[8] = by_pose[9], by_pose[10], by_pose[11]


@leaf
def _pull_back_planar(space, x, by_pose, gradient):
    sine, cosine = sine_cosine(x[0])
    by_angle = 0.0
    for i in range(9):
        slope = cosine * space.turning[i] + sine * space.turning_squared[i]
        by_angle += by_pose[i] * slope
    gradient[0] = by_angle
    for axis, along in enumerate((space.e_u, space.e_v)):
        slope = by_pose[9] * along[0] + by_pose[10] * along[1] + by_pose[11] * along[2]
        gradient[1 + axis] = slope


@leaf
def finite(pose):
    """Return whether the squares of a pose's numbers are finite."""
    total = 0.0
    for value in pose:
        total += value * value
    return total < np.inf


@leaf
def all_finite(vector):
    """Return whether a vector holds neither infinity nor NaN."""
    finite = True
    for x in vector:
        finite &= np.isfinite(x)
    return finite


@leaf
def rigid(pose):
    """Return whether the rows of a pose's rotation are orthonormal up to rounding."""
    worst = 0.0
    for i in range(3):
        for j in range(i + 1):
            a, b = 3 * i, 3 * j
            product = pose[a] * pose[b] + pose[a + 1] * pose[b + 1] + pose[a + 2] * pose[b + 2]
            worst = max(worst, abs(product - (1.0 if i == j else 0.0)))
    return worst < 1e-9


@leaf
def pose_at(poses, n):
    """Return row n of poses (B, 12)."""
    a, b, c, d = poses[n, 0], poses[n, 1], poses[n, 2], poses[n, 3]
    e, f, g, h = poses[n, 4], poses[n, 5], poses[n, 6], poses[n, 7]
    return a, b, c, d, e, f, g, h, poses[n, 8], poses[n, 9], poses[n, 10], poses[n, 11]


@leaf
def moved(pose, x, y, z):
    """Return R p + t of a point p = x, y, z."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )


@leaf
def origin_within(pose, low, high):
    """Return whether the object's origin, -R^T t in the world, lies in a box."""
    x = -(pose[0] * pose[9] + pose[3] * pose[10] + pose[6] * pose[11])
    y = -(pose[1] * pose[9] + pose[4] * pose[10] + pose[7] * pose[11])
    z = -(pose[2] * pose[9] + pose[5] * pose[10] + pose[8] * pose[11])
    return low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]


@leaf
def turned(pose, x, y, z):
    """Return R v of a vector v = x, y, z."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z,
        pose[3] * x + pose[4] * y + pose[5] * z,
        pose[6] * x + pose[7] * y + pose[8] * z,
    )


@leaf
def turned_back(pose, x, y, z):
    """Return R^T v of a vector v = x, y, z."""
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@leaf
def composed(left, right):
    """Return the pose that moves by `right`, then by `left`."""
    a, d, g = turned(left, right[0], right[3], right[6])
    b, e, h = turned(left, right[1], right[4], right[7])
    c, f, i = turned(left, right[2], right[5], right[8])
    x, y, z = moved(left, right[9], right[10], right[11])
    return a, b, c, d, e, f, g, h, i, x, y, z


@leaf
def inverted(pose):
    """Return the inverse of a rigid pose: R^T, -R^T t."""
    a, b, c, d, e, f, g, h, i, x, y, z = pose
    u, v, w = turned_back(pose, x, y, z)
    return a, d, g, b, e, h, c, f, i, -u, -v, -w


@compiled
def decode_all(space, vectors, poses):
    """Fill poses (B, 12) from search vectors (B, d)."""
    for n in range(len(vectors)):
        pose = decode(space, vectors[n])
        for i in range(12):
            poses[n, i] = pose[i]


@leaf
def _length(x, y, z):
    return max(np.sqrt(x * x + y * y + z * z), _SHORTEST)
