"""The prior on the pose (see `chsel.problem.pose_prior`) in kernels, one pose at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.elementary import arctangent, exp, exps, log, sine_cosine
from chsel.numerics.pose_tuples import moved, pose_at, turned, turned_back
from chsel.problem.pose_prior import WRONG, PosePrior, centre_of
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid

_LEAST_SHARE = 1e-9  # of a pose of another estimator in the gradient
_FAR = 100.0  # squared Mahalanobis distance beyond which a Gaussian counts for nothing, e^-50
_SMALL = 0.01  # radians, below which a series is more accurate


class Prior(NamedTuple):
    """A prior as kernels read it; the arrays of parts that are absent have no rows."""

    centre: FloatArray  # (C, 3), world, metres; C is 0 or 1
    point: FloatArray  # (C, 3), object frame, metres
    centre_precision: float  # 1/m^2
    axis: FloatArray  # (A, 3), unit vectors, object frame; A is 0 or 1
    along: FloatArray  # (A, 3), unit vectors, world
    axis_precision: float  # 1/rad^2, about each of two axes
    poses: FloatArray  # (J, 12), of another estimator
    centres: FloatArray  # (J, 3), of the object's centre in these poses, world, metres
    whitening: FloatArray  # (J, 6, 6), lower triangular
    densities: FloatArray  # (J,), g_j at their poses
    middle: tuple[float, float, float]  # the object's centre, object frame, metres
    wrong: float  # w


def prior_of(prior: PosePrior | None, sdf: SdfGrid) -> Prior:
    """Return a prior on the pose of an object as kernels read it. None: nothing is known of it."""
    none = np.zeros((0, 3))
    values = Prior(
        centre=none,
        point=none,
        centre_precision=0.0,
        axis=none,
        along=none,
        axis_precision=0.0,
        poses=np.zeros((0, 12)),
        centres=none,
        whitening=np.zeros((0, 6, 6)),
        densities=np.zeros(0),
        middle=(0.0, 0.0, 0.0),
        wrong=float(exps(-WRONG)),
    )
    if prior is None:
        return values
    if prior.centre is not None and prior.centre_noise is not None:
        values = values._replace(
            centre=np.array([prior.centre]),
            point=np.array([prior.point_on(sdf)]),
            centre_precision=1.0 / prior.centre_noise**2,
        )
    if prior.axis is not None and prior.along is not None and prior.axis_noise is not None:
        values = values._replace(
            axis=np.array([prior.axis]),
            along=np.array([prior.along]),
            axis_precision=2.0 / prior.axis_noise**2,
        )
    if prior.object_from_world is not None:
        others = Poses.of(prior.object_from_world)
        values = values._replace(
            poses=np.array(others.numbers),
            centres=prior.centres(sdf),
            whitening=np.array(prior.whitening),
            densities=prior.densities(sdf),
            middle=triple(centre_of(sdf)),
        )
    return values


@leaf
def prior_energy(prior, pose):
    """Return the energy of a pose by the prior, nats; 0 without one."""
    if len(prior.centre) + len(prior.axis) + len(prior.poses) == 0:
        return 0.0
    right = (1.0 - prior.wrong) * exp(-_quadratic_cost(prior, pose))
    if len(prior.poses) > 0:
        right *= min(_mixture(prior, pose), 1.0)
    return -log(right + prior.wrong)


@inner
def add_prior(prior, pose, pivot, sums):
    """Add the residuals of the prior to sums over twists about a point, as `Fit` has them.

    They count by the chance that the prior is right.
    """
    if len(prior.centre) + len(prior.axis) + len(prior.poses) == 0:
        return
    right = (1.0 - prior.wrong) * exp(-_quadratic_cost(prior, pose))
    total = _mixture(prior, pose) if len(prior.poses) > 0 else 1.0
    right *= min(total, 1.0)
    chance = right / (right + prior.wrong)
    for n in range(len(prior.centre)):
        x, y, z = moved(pose, prior.centre[n, 0], prior.centre[n, 1], prior.centre[n, 2])
        off = x - prior.point[n, 0], y - prior.point[n, 1], z - prior.point[n, 2]
        arm = x - pivot[0], y - pivot[1], z - pivot[2]
        _add_vector(sums, arm, off, chance * prior.centre_precision, 1.0)
    for n in range(len(prior.axis)):
        x, y, z = turned(pose, prior.along[n, 0], prior.along[n, 1], prior.along[n, 2])
        off = x - prior.axis[n, 0], y - prior.axis[n, 1], z - prior.axis[n, 2]
        _add_vector(sums, (x, y, z), off, chance * prior.axis_precision, 0.0)
    place = _place(prior, pose)
    for j in range(len(prior.poses)):
        if not _is_near(prior, place, j):
            continue
        offset = _offset(prior, pose, j)
        density = _density(prior, offset, j)
        if density > _LEAST_SHARE * total:
            _add_pose(prior, pose, pivot, j, offset, chance * density / total, sums)


@leaf
def _quadratic_cost(prior, pose):
    """Return the part of q, nats, that is due to a point and to an axis."""
    cost = 0.0
    for n in range(len(prior.centre)):
        x, y, z = moved(pose, prior.centre[n, 0], prior.centre[n, 1], prior.centre[n, 2])
        x, y, z = x - prior.point[n, 0], y - prior.point[n, 1], z - prior.point[n, 2]
        cost += 0.5 * prior.centre_precision * (x * x + y * y + z * z)
    for n in range(len(prior.axis)):
        x, y, z = turned(pose, prior.along[n, 0], prior.along[n, 1], prior.along[n, 2])
        x, y, z = x - prior.axis[n, 0], y - prior.axis[n, 1], z - prior.axis[n, 2]
        cost += 0.5 * prior.axis_precision * (x * x + y * y + z * z)
    return cost


@inner
def _mixture(prior, pose):
    """Return sum_j g_j."""
    total = 0.0
    place = _place(prior, pose)
    for j in range(len(prior.poses)):
        if _is_near(prior, place, j):
            total += _density(prior, _offset(prior, pose, j), j)
    return total


@leaf
def _place(prior, pose):
    """Return where the object's centre is in a pose, world, metres."""
    x, y, z = prior.middle
    return turned_back(pose, x - pose[9], y - pose[10], z - pose[11])


@leaf
def _is_near(prior, place, j):
    """Return whether g_j can count where the object's centre is at a place, whatever the turn."""
    x, y, z = place
    x, y, z = x - prior.centres[j, 0], y - prior.centres[j, 1], z - prior.centres[j, 2]
    square = 0.0
    for k in range(3):  # whitening is lower triangular
        white = prior.whitening[j, k, 0] * x
        white += prior.whitening[j, k, 1] * y + prior.whitening[j, k, 2] * z
        square += white * white
    return square < _FAR


@leaf
def _density(prior, offset, j):
    """Return g_j at an offset."""
    square = 0.0
    for k in range(6):
        white = _whitened(prior, offset, j, k)
        square += white * white
    return prior.densities[j] * exp(-0.5 * square)


@leaf
def _whitened(prior, offset, j, k):
    """Return the k-th of the standard normal numbers of an offset from pose j."""
    total = 0.0
    for i in range(k + 1):
        total += prior.whitening[j, k, i] * offset[i]
    return total


@inner
def _offset(prior, pose, j):
    """Return how a pose is off pose j: of the centre, metres, and the rotation vector, world."""
    x, y, z = _place(prior, pose)
    other = pose_at(prior.poses, j)
    a, d, g = turned_back(pose, other[0], other[3], other[6])
    b, e, h = turned_back(pose, other[1], other[4], other[7])
    c, f, i = turned_back(pose, other[2], other[5], other[8])
    u, v, w = _rotation_vector(a, b, c, d, e, f, g, h, i)
    return x - prior.centres[j, 0], y - prior.centres[j, 1], z - prior.centres[j, 2], u, v, w


@leaf
def _rotation_vector(a, b, c, d, e, f, g, h, i):
    """Return the rotation vector of a matrix, row by row, by its quaternion's largest entry."""
    trace = a + e + i
    if trace >= max(a, e, i):
        x, y, z, w = h - f, c - g, d - b, 1.0 + trace
    elif a >= max(e, i):
        x, y, z, w = 1.0 + a - e - i, b + d, c + g, h - f
    elif e >= i:
        x, y, z, w = b + d, 1.0 - a + e - i, f + h, c - g
    else:
        x, y, z, w = c + g, f + h, 1.0 - a - e + i, d - b
    size = np.sqrt(x * x + y * y + z * z)
    if size == 0.0:
        return 0.0, 0.0, 0.0
    factor = 2.0 * arctangent(size, abs(w)) / size
    if w < 0.0:
        factor = -factor
    return factor * x, factor * y, factor * z


@leaf
def _add_vector(sums, arm, off, weight, shifts):
    """Add a residual (3,) that turns change by their cross product with an arm.

    shifts: 1 where a shift changes it as much, 0 where none does.
    """
    for i in range(3):
        nx, ny, nz = 1.0 * (i == 0), 1.0 * (i == 1), 1.0 * (i == 2)
        rates = sums[7]
        rates[0] = arm[1] * nz - arm[2] * ny
        rates[1] = arm[2] * nx - arm[0] * nz
        rates[2] = arm[0] * ny - arm[1] * nx
        rates[3], rates[4], rates[5] = shifts * nx, shifts * ny, shifts * nz
        _add_rates(sums, weight, off[i])


@inner
def _add_pose(prior, pose, pivot, j, offset, weight, sums):
    """Add the six standard normal numbers of an offset from pose j."""
    middle = prior.middle
    ax, ay, az = middle[0] - pivot[0], middle[1] - pivot[1], middle[2] - pivot[2]
    px, py, pz = offset[3], offset[4], offset[5]
    second = _second_rate(np.sqrt(px * px + py * py + pz * pz))
    white = prior.whitening
    for k in range(6):
        x, y, z = turned(pose, white[j, k, 0], white[j, k, 1], white[j, k, 2])
        h, v, w = white[j, k, 3], white[j, k, 4], white[j, k, 5]
        # J^T h of the turn, J = I - [p]/2 + second [p]^2 for the rotation vector p.
        cx, cy, cz = py * w - pz * v, pz * h - px * w, px * v - py * h
        h += 0.5 * cx + second * (py * cz - pz * cy)
        v += 0.5 * cy + second * (pz * cx - px * cz)
        w += 0.5 * cz + second * (px * cy - py * cx)
        h, v, w = turned(pose, h, v, w)
        rates = sums[7]
        rates[0] = -(ay * z - az * y) - h
        rates[1] = -(az * x - ax * z) - v
        rates[2] = -(ax * y - ay * x) - w
        rates[3], rates[4], rates[5] = -x, -y, -z
        _add_rates(sums, weight, _whitened(prior, offset, j, k))


@leaf
def _second_rate(angle):
    """Return (1 - a/2 cot(a/2)) / a^2, of the inverse of the Jacobian of SO(3)."""
    if angle < _SMALL:
        return 1.0 / 12.0 + angle * angle / 720.0
    sine, cosine = sine_cosine(0.5 * angle)
    return (1.0 - 0.5 * angle * cosine / sine) / (angle * angle)


@leaf
def _add_rates(sums, weight, residual):
    """Add a residual whose rates by twists are in row 7."""
    rates = sums[7]
    for i in range(6):
        weighted = weight * rates[i]
        sums[6, i] += weighted * residual
        for j in range(i + 1):
            sums[i, j] += weighted * rates[j]
