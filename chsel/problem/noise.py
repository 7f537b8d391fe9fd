"""A model of the errors of points, and the energy of poses by it.

    E(X) = -log sum_k w_k prod_i [(1 - e) N(r_i; 0, s_k) F_i + e / D]^t
           + t F(sum_j min(d_j^2 / 2 f^2, c))

in nats, up to a constant: minus the log-likelihood of a pose by all points. Known points have
residuals r_i = s(X p_i) - v_i, free points depths d_j below the surface, occupied ones heights d_j
above it. Contacts are off by s_k^2 = n^2 + m_k^2: the noise n of the sensor, and errors m_k of
mesh, hand and camera, of which only a prior w_k is known; so the sum over k is the evidence for
the pose. A share e of the contacts is on other objects, anywhere within D. The border of a free
voxel is off by f, and one in exp(c) is wrong; where one is, others are likelier to be, so beyond c
costs count less (F). Many points have errors in common: with N > INDEPENDENT known ones, t is
INDEPENDENT / N.

F_i is 1 for a contact without a normal. Else it is the density of the normal by that of a uniform
direction, where a share a of the normals is wrong:

    F_i = (1 - a) (1 + 2 b)^2 / ((1 + b) (1 + b (1 - cos))^3) + a,      b = 1 / 2 v

cos is that of the angle between the normal and the gradient g_i of the distance at X p_i, and v the
variance of the angle about each of two axes: that of the sensor, of a surface that is not flat, and
1 - |g_i|, as gradients around an edge cancel. The density is that of Student's t with 4 degrees of
freedom, on the sphere: normals that are off by more than stated cost little more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.elementary import exps, logs

PRIOR_CONTACTS = 4.0  # that the sensor's noise counts for
PRIOR_OUTLIERS = 0.02  # the share of outliers in them
FOREIGN = 4.0  # noise levels beyond which a contact is an outlier
FREEDOMS = 6  # of a pose: it can make so many distances small whatever the noise
LIMIT = 9.0  # nats above the best pose up to which others are likely, too
LEVELS = 8  # K
_LEAST_ERROR, _MOST_ERROR = 0.0006, 0.008  # metres: m_1 and m_K, in geometric steps
_USUAL_ERROR, _WIDTH = 0.002, 0.6  # of w: centre in metres, standard deviation of ln m
SHARE, EXTENT = 0.03, 0.15  # e, and D in metres
SOFTNESS, WRONG = 0.002, 7.0  # f in metres, and c
LATER = 0.2  # of the costs beyond c
FACET = 0.08  # radians: what normals are off as a surface is not flat, about each axis
WRONG_NORMALS = 0.1  # a
INDEPENDENT = 30.0  # known points: of more, errors are alike
_MEDIAN = 1.4826  # standard deviations of normal numbers by the median of their sizes
_ROUNDS = 20


class Noise(NamedTuple):
    """The estimated noise of known points."""

    sigma: float  # standard deviation of those that are on the object, metres
    outliers: float  # share of those that are not


def estimate_noise(distances: FloatArray, sensor_noise: float) -> Noise:
    """Return noise and share of outliers by distances (N,), in metres, at the best pose.

    Both at once: an outlier is a distance beyond FOREIGN sigma, and sigma is that of all others.
    The sensor's noise, metres, counts as that of PRIOR_CONTACTS further contacts (the mean of a
    scaled inverse chi-squared distribution), as a pose can be fitted to six distances whatever
    their noise. Sigma is no less than it, as errors that contacts share do not show. Sums are
    rounded once, so that the result does not depend on the machine.
    """
    sizes = np.sort(np.abs(np.asarray(distances, dtype=np.float64)))
    count = len(sizes)
    middle = 0.5 * (sizes[(count - 1) // 2] + sizes[count // 2]) if count else 0.0
    sigma = max(sensor_noise, _MEDIAN * float(middle))
    within = -1
    for _ in range(_ROUNDS):
        before = within
        within = int(np.searchsorted(sizes, FOREIGN * sigma, side="right"))
        if within == before:
            break
        squares = math.fsum((sizes[:within] ** 2).tolist())
        weight = PRIOR_CONTACTS + max(within - FREEDOMS, 0)
        sigma = math.sqrt((PRIOR_CONTACTS * sensor_noise**2 + squares) / weight)
    foreign = PRIOR_CONTACTS * PRIOR_OUTLIERS + count - max(within, 0)
    return Noise(max(sigma, sensor_noise), foreign / (PRIOR_CONTACTS + count))


class PosedNormals(NamedTuple):
    """Normals of N known points beside the gradients of the distance in B poses."""

    noise: FloatArray  # (N,), radians; 0 where there is no normal
    cosines: FloatArray  # (B, N), of the angles between normals and gradients
    lengths: FloatArray  # (B, N), of the gradients


@dataclass(frozen=True)
class NoiseModel:
    """A model of the errors of points."""

    sigmas: tuple[float, ...]  # s_k, metres, ascending
    weights: tuple[float, ...]  # w_k, whose sum is 1
    softness: float = SOFTNESS  # f, metres
    wrong: float = WRONG  # c, nats
    shared: float = 0.0  # metres, of residuals and of depths, that cost nothing
    least_normal_noise: float = 0.0  # radians, of normals whose own noise is less

    def densities(self, residuals: FloatArray) -> FloatArray:
        """Return (1 - e) N (..., K) of residuals (...), metres."""
        sigmas = np.array(self.sigmas)
        peak = (1.0 - SHARE) / (math.sqrt(2.0 * math.pi) * sigmas)
        sizes = np.maximum(np.abs(residuals) - self.shared, 0.0)[..., None]
        return peak * exps(-0.5 * (sizes / sigmas) ** 2)

    def normal_variances(self, noise: FloatArray) -> FloatArray:
        """Return variances (N,) of normals of a noise (N,), about each of two axes, radians^2.

        They are those on flat faces; 0 where there is no normal.
        """
        wide = np.maximum(noise, self.least_normal_noise)
        return np.where(noise > 0.0, 0.5 * wide**2 + FACET**2, 0.0)

    def greatest(self, variances: FloatArray) -> FloatArray:
        """Return the greatest density (N,) of contacts whose normals have variances (N,)."""
        peak = float(self.densities(np.zeros(1))[0, 0])
        return peak * normal_factors(variances, np.ones(len(variances))) + SHARE / EXTENT

    def energies(
        self,
        residuals: FloatArray,
        depths: FloatArray,
        *,
        normals: PosedNormals | None = None,
    ) -> FloatArray:
        """Return E (B,) of poses by residuals (B, N) and depths (B, M), metres.

        normals: of the known points; None where there are none.
        """
        density = self.densities(residuals)
        variances = np.zeros(residuals.shape[1])
        if normals is not None:
            variances = self.normal_variances(normals.noise)
            density = density * self._factors(variances, normals)[..., None]
        greatest = self.greatest(variances)[:, None]
        costs = logs(greatest / (density + SHARE / EXTENT)).sum(axis=1)
        power = self.power(residuals.shape[1])
        levels = power * costs - logs(np.array(self.weights))  # (B, K)
        least = levels.min(axis=1)
        known = least - logs(exps(least[:, None] - levels).sum(axis=1))
        deep = np.maximum(depths - self.shared, 0.0)
        wrong = np.minimum(0.5 * (deep / self.softness) ** 2, self.wrong).sum(axis=1)
        return known + power * np.minimum(wrong, self.wrong + LATER * (wrong - self.wrong))

    def _factors(self, variances: FloatArray, normals: PosedNormals) -> FloatArray:
        """Return F (B, N)."""
        edges = np.maximum(1.0 - normals.lengths, 0.0)
        spread = np.where(variances > 0.0, variances + edges, 0.0)
        return normal_factors(spread, normals.cosines)

    def power(self, known: int) -> float:
        """Return t, for so many known points."""
        return min(1.0, INDEPENDENT / max(known, 1))


def normal_factors(variances: FloatArray, cosines: FloatArray) -> FloatArray:
    """Return F (...) by variances (...), radians^2, and cosines (...); 1 where a variance is 0."""
    b = 0.5 / np.where(variances > 0.0, variances, 1.0)
    off = 1.0 + b * (1.0 - cosines)
    density = (1.0 + 2.0 * b) ** 2 / ((1.0 + b) * (off * off * off))
    return np.where(variances > 0.0, (1.0 - WRONG_NORMALS) * density + WRONG_NORMALS, 1.0)


def noise_model(sensor_noise: float, shared: float = 0.0) -> NoiseModel:
    """Return the model of a sensor of that standard deviation, metres."""
    ratio = (_MOST_ERROR / _LEAST_ERROR) ** (1.0 / (LEVELS - 1))
    errors = [_LEAST_ERROR * ratio**k for k in range(LEVELS)]
    prior = [math.exp(-0.5 * (math.log(m / _USUAL_ERROR) / _WIDTH) ** 2) for m in errors]
    sigmas = tuple(math.sqrt(sensor_noise**2 + m**2) for m in errors)
    return NoiseModel(sigmas, tuple(p / math.fsum(prior) for p in prior), shared=shared)
