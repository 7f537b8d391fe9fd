"""Whether an object can be moved without its known points becoming unlikely.

A set of hypotheses may leave out what its method has not found. So the best one is moved along the
motions that contacts resist the least for how far they move the surface: the largest solutions of
M v = lambda A v, with the mean squares v^T A v by which contacts leave the surface and v^T M v by
which the surface leaves itself.
"""

from __future__ import annotations

import math

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.noise import LIMIT, NoiseModel, noise_model
from chsel.problem.outline import (
    in_order,
    outline_distances_to,
    outline_in_world,
    signed_distances,
)
from chsel.problem.poses import Poses, compose, product, rotated, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.subset import evenly_spaced

_SOFT = 1e-4  # added to A: of (m / m)^2
_ROUNDS = 4  # of the subspace iteration
_LEAST_LENGTH = 1e-3  # of a motion of the surface, of the object's motion
_MOST_KNOWN, _MOST_FREE = 1000, 5000


def can_be_moved(
    problem: RegistrationProblem, pose: Poses, sensor_noise: float, distance: float
) -> bool:
    """Whether the points stay about as likely if the object's surface moves by a distance, metres.

    pose: one. Likely in the sense of Wilks (1938): by a likelihood ratio, see `LIMIT`.
    """
    motions = _loosest_motions(problem, pose)
    if len(motions) == 0:
        return False
    moved = _moved(problem, pose, distance * np.concatenate([motions, -motions]))
    energies = pose_energies(problem, Poses.joined([pose, moved]), noise_model(sensor_noise))
    apart = outline_distances_to(problem.sdf, moved, pose)  # near for turns that are symmetries
    likely = (energies[1:] - energies[0] <= LIMIT) & (apart >= 0.5 * distance)
    return bool(likely.any())


def _loosest_motions(problem: RegistrationProblem, pose: Poses) -> FloatArray:
    """Twists (K, 6) as `_moved` takes them, K at most 6, by which the surface moves by 1."""
    sdf, step = problem.sdf, 0.5 * problem.sdf.resolution
    nearby = _moved(problem, pose, step * np.concatenate([np.eye(6), -np.eye(6)]))

    def products(points: FloatArray) -> FloatArray:
        """Mean products (6, 6) of the rates at which distances of world points change."""
        distances = signed_distances(sdf, nearby, points)  # (12, N)
        rates = (distances[:6] - distances[6:]) / (2.0 * step)
        return in_order(rates[:, None] * rates) / max(len(points), 1)

    known = problem.points.known[evenly_spaced(len(problem.points.known), _MOST_KNOWN)]
    resisted = products(known) + _SOFT * np.eye(6)
    metric = products(outline_in_world(sdf, pose)[0])
    motions = np.eye(6)
    for _ in range(_ROUNDS):
        motions = _solved(resisted, in_order(metric * motions[:, None]))
        motions = _orthonormal(motions, metric)
    return motions


def _orthonormal(vectors: FloatArray, metric: FloatArray) -> FloatArray:
    """Vectors (K, 6) of length 1 by a metric (6, 6), each without its part along those before it.

    Vectors of next to no length are left out, such as turns that are symmetries of the object.
    """
    found: list[FloatArray] = []
    for vector in vectors:
        size = float(np.abs(vector).max())
        for other in found:
            vector = vector - in_order(in_order(metric * other) * vector) * other
        length = math.sqrt(max(float(in_order(in_order(metric * vector) * vector)), 0.0))
        if length > _LEAST_LENGTH * size:
            found.append(vector / length)
    return np.array(found).reshape(-1, 6)


def _moved(problem: RegistrationProblem, pose: Poses, twists: FloatArray) -> Poses:
    """A pose after motions (K, 6) of the object: shifts, and turns about its middle, metres.

    Turns are lengths of arc at half a diameter.
    """
    centre = problem.sdf.bounds.mean(axis=0)
    turn = rotation_vector(twists[:, 3:] / max(0.5 * problem.sdf.diameter, problem.sdf.resolution))
    shift = centre + twists[:, :3] - rotated(turn, centre)
    turned = product(turn, np.broadcast_to(pose.rotations, turn.shape))
    return Poses.of(compose(turned, rotated(turn, pose.translations) + shift))


def pose_energies(problem: RegistrationProblem, poses: Poses, noise: NoiseModel) -> FloatArray:
    """Minus the log-likelihood (B,) of the points in poses, nats, see `chsel.problem.noise`.

    Of many points by some; those left out count for nothing.
    """
    points, sdf = problem.points, problem.sdf
    known = evenly_spaced(len(points.known), _MOST_KNOWN)
    residuals = signed_distances(sdf, poses, points.known[known]) - points.sdf[known]
    free, occupied = (
        group[evenly_spaced(len(group), _MOST_FREE)] for group in (points.free, points.occupied)
    )
    depths = [-signed_distances(sdf, poses, free), signed_distances(sdf, poses, occupied)]
    return noise.energies(residuals, np.concatenate(depths, axis=1))


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions x (K, 6) of matrix x = right (K, 6), positive definite, by elimination."""
    rows = np.concatenate([matrix, right.T], axis=1)  # (6, 6 + K)
    for i in range(6):
        rows[i] = rows[i] / rows[i, i]
        for j in range(6):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return np.ascontiguousarray(rows[:, 6:].T)
