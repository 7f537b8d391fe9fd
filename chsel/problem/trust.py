"""The trust in hypotheses: whether they explain the points, and whether they are alike.

The set is judged by the object's signed distances, whatever the method and its cost are.
docs/trust.md has the model, and what its limits were chosen on.
"""

from __future__ import annotations

import math

import numpy as np

from chsel.errors import PointsWarning, PoseError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from chsel.numerics.elementary import logs
from chsel.problem.noise import (
    FOREIGN,
    FREEDOMS,
    LIMIT,
    NoiseModel,
    PosedNormals,
    estimate_noise,
    noise_model,
)
from chsel.problem.points import KnownPoints
from chsel.problem.pose_distances import (
    angles_apart,
    distances_apart,
    distances_apart_from,
    turned,
)
from chsel.problem.poses import Poses, compose, product, rotated, rotation_vector
from chsel.problem.registration_problem import VERDICTS, Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.surface import (
    in_order,
    outline_in_world,
    signed_distances,
    surface_gradients,
    surface_spread,
)

SENSOR_NOISE = 0.0005  # metres, of known points, where nothing is known about the sensor
DETERMINED, SEVERAL, WIDE, NOTHING = VERDICTS

# In diameters of the object:
MOST_OFF = 0.04  # average error of points
MOST_SYSTEMATIC = 0.012  # the same, if errors of neighbours are alike
MOST_WIDTH = 0.03  # spread of a mode, and distance from a pose to the next one of its mode
SURE_SHARE = 0.05  # what a pose that is determined may be off, if that is less than SURE_WITHIN

SURE_WITHIN = 0.01  # metres that the centre of a pose that is determined may be off
SURE_TURN = math.radians(10.0)  # that such a pose may be turned

MOST_OUTLIERS = 0.3  # share
MOST_MODES = 8  # sets of more are wide
MOST_LEVELS = 10.0  # sensor noise levels that errors may have without a warning
MOST_LEVELS_OF_MANY = 5.0  # the same, where MANY_BEYOND known points are more than a pose can fit
MANY_BEYOND = 10
LEAST_LEVELS = 3.0  # sensor noise levels that errors and widths may have on small objects
NEAR_LIMIT = 1.5  # times LIMIT that moving a pose costs, below which the result says so
LEAST_GAP = 2.0  # noise levels, as estimated, between modes
SYSTEMATIC = 0.5  # correlation of the errors of neighbours
MOST_NOISE = 0.015  # metres: contacts that are off by more, or three times the sensor's noise
MANY_CONTACTS = 20  # among which one on another object would show
FOREIGN_CONTACT = 4.0  # nats beyond LIMIT that a pose costs which leaves out one of few contacts
_GRID_ERROR = 0.3  # of interpolated distances, in spacings of nodes
_NEIGHBOURS = 3
_LEAST_CORRELATED = 8  # points

_MOST_HYPOTHESES = 100  # that are compared, the best ones
_MOST_CORRELATED = 300
_SOFT = 1e-4  # added to A, see motion_cost: of (m / m)^2
_ROUNDS = 4  # of the subspace iteration
_LEAST_LENGTH = 1e-3  # of a motion of the surface, of the object's motion
_MOST_KNOWN, _MOST_FREE = 1000, 5000
_LEAST_GRADIENT = 1e-12  # length of one that has a direction


def trust_in(
    problem: RegistrationProblem,
    hypotheses: Hypotheses,
    *,
    sensor_noise: float = SENSOR_NOISE,
    rivals: Poses | None = None,
) -> Trust:
    """Return the trust in the hypotheses of a problem: a pure function, the same bits everywhere.

    sensor_noise: standard deviation of known points by the sensor's datasheet, metres. rivals:
    further poses, which speak against the best hypothesis where they fit; with less than
    MANY_CONTACTS, also where they leave out one.
    Raises PoseError if there is no hypothesis or the best is not finite, and SettingError for noise
    that is not above 0.
    """
    require_positive("sensor_noise", sensor_noise)
    problem = problem.carried(hypotheses.push_distance)
    sdf, points = problem.sdf, problem.points
    poses, indices = explaining(problem, hypotheses, sensor_noise=sensor_noise, rivals=rivals)
    off = signed_distances(sdf, poses[:1], points=points.known)[0] - points.sdf
    noise = estimate_noise(off, sensor_noise)
    most = FOREIGN * noise.sigma
    error = float(_mean_error(problem, poses[:1], sensor_noise=sensor_noise, most=most))
    alike = correlation(points.known, np.clip(off, -most, most)) > SYSTEMATIC
    share = MOST_SYSTEMATIC if alike else MOST_OFF
    limit = max(share * sdf.diameter, _GRID_ERROR * sdf.resolution, LEAST_LEVELS * sensor_noise)

    apart = distances_apart(sdf, poses)
    width = mode_width(sdf, sensor_noise)
    gap = max(width, LEAST_GAP * noise.sigma)
    near = apart <= gap
    differ = turned(sdf, poses, pairs=near)
    count, mode = _components(near & ~differ)
    parts = [np.flatnonzero(mode == one) for one in range(count)]
    redundancy = max(len(off) - FREEDOMS, 0)
    why = ""
    worst = max(MOST_NOISE, LEAST_LEVELS * sensor_noise)
    if error > limit or noise.outliers > MOST_OUTLIERS or noise.sigma > worst:
        verdict = NOTHING
    elif not sdf.has_inside or LEAST_LEVELS * sdf.surface_error > width:
        verdict = WIDE
        why = "the SDF grid is too coarse for the object"
    elif redundancy + len(points.free) + len(points.occupied) == 0:
        verdict = WIDE
        why = "no more contacts than a pose can fit"
    elif error > most_error(redundancy, sensor_noise):
        verdict = WIDE
        why = f"errors far above the noise of {1000.0 * sensor_noise:g} mm that is stated"
    elif count > MOST_MODES:
        verdict = WIDE
        why = f"{count} groups of poses"
    elif max(surface_spread(apart[np.ix_(part, part)]) for part in parts) > width:
        verdict = WIDE
    elif sdf.symmetry is not None and any(differ[np.ix_(part, part)].any() for part in parts):
        verdict = WIDE
        why = "turns that are no declared symmetry look alike"
    else:
        bests = [poses[part[:1]] for part in parts]
        way = sure_within(sdf, sensor_noise)
        cost = min(
            motion_cost(problem, pose, sensor_noise=sensor_noise, distance=way) for pose in bests
        )
        if cost <= NEAR_LIMIT * LIMIT:
            least = max(cost, 0.0)
            why = f"moving it {1000.0 * way:.1f} mm costs {least:.1f} nats, wide up to {LIMIT:g}"
        verdict = WIDE if cost <= LIMIT else DETERMINED if count == 1 else SEVERAL
    if verdict in (NOTHING, WIDE):
        count = 0  # groups of such poses are no modes
    firsts = [int(indices[part[0]]) for part in parts[: max(count, 1)]]
    best = tuple(index for index in firsts if index >= 0)
    twins = _largest_turn(poses, apart, parts=parts) if verdict == SEVERAL and near.all() else None
    return Trust(
        noise=noise.sigma,
        outliers=noise.outliers,
        misfit=error / sensor_noise,
        modes=count,
        spread=surface_spread(apart),
        verdict=verdict,
        redundancy=redundancy,
        best_of_modes=best,
        twins=twins,
        limit=width,
        reason=why,
    )


def explaining(
    problem: RegistrationProblem,
    hypotheses: Hypotheses,
    *,
    sensor_noise: float,
    rivals: Poses | None = None,
) -> tuple[Poses, IntArray]:
    """Return the poses (K, 12) that explain the points, best hypothesis first, and indices (K,).

    Arguments and errors as of `trust_in`, but that no push is left; the index of a rival is -1.
    """
    poses, indices = _compared(hypotheses)
    count = len(poses)
    if rivals is not None:
        poses = Poses.joined([poses, rivals])
        indices = np.concatenate([indices, np.full(len(rivals), -1)])
    noise = noise_model(sensor_noise)
    energies = pose_energies(problem, poses, noise=noise)
    allowed = np.full(len(poses), energies.min() + LIMIT)
    if len(problem.points.known) < MANY_CONTACTS:
        allowed[count:] += FOREIGN_CONTACT + _normal_cost(problem.points, noise)
    likely = energies <= allowed
    likely[0] = True
    return poses[likely], indices[likely]


def _normal_cost(points: KnownPoints, noise: NoiseModel) -> float:
    """Return what it costs more to leave out a contact with a normal than one without, nats."""
    if not points.has_normals:
        return 0.0
    variances = noise.normal_variances(points.normal_noise)
    ratios = noise.greatest(variances) / noise.greatest(np.zeros(len(variances)))
    return float(logs(ratios).max())


def mode_width(sdf: SdfGrid, sensor_noise: float) -> float:
    """Return how far apart poses of a mode are at most, metres. sensor_noise: metres."""
    return max(MOST_WIDTH * sdf.diameter, LEAST_LEVELS * sensor_noise)


def sure_within(sdf: SdfGrid, sensor_noise: float) -> float:
    """Return how far off a pose that is determined may be, metres. sensor_noise: metres."""
    return max(min(SURE_SHARE * sdf.diameter, SURE_WITHIN), LEAST_LEVELS * sensor_noise)


def fits_elsewhere(
    problem: RegistrationProblem,
    hypotheses: Hypotheses,
    *,
    other: RegistrationProblem,
    poses: Poses,
    sensor_noise: float,
) -> bool:
    """Return whether a pose far from the best explains another problem about as well.

    problem, other: of one object, that pushes have moved by different distances.
    """
    best = Poses.of(hypotheses.object_from_world[:1])
    noise = noise_model(sensor_noise)
    limit = pose_energies(problem, best, noise=noise)[0] + LIMIT
    apart = distances_apart_from(problem.sdf, poses, other=best)
    width = mode_width(problem.sdf, sensor_noise)
    return bool(((pose_energies(other, poses, noise=noise) <= limit) & (apart > width)).any())


def _largest_turn(poses: Poses, apart: FloatArray, *, parts: list[IntArray]) -> tuple[float, float]:
    """Return the angle (radians) and distance (m) of the two modes that differ most."""
    firsts = [int(part[0]) for part in parts]
    angles = angles_apart(poses[np.array(firsts)])
    one, other = np.unravel_index(int(np.argmax(angles)), angles.shape)
    return float(angles[one, other]), float(apart[firsts[one], firsts[other]])


def check_trust(trust: Trust, sensor_noise: float = SENSOR_NOISE) -> list[PointsWarning]:
    """Return a warning if no hypothesis explains the points, or only with more noise.

    The texts have no measured numbers, so that Python shows repeated ones once.
    """
    if trust.verdict == NOTHING:
        text = (
            "no hypothesis explains the points, see the trust in the result; check units, frames, "
            "the object and its scale, and whether it moved"
        )
        return [PointsWarning("no_fit", text)]
    most = most_error(trust.redundancy, sensor_noise) / sensor_noise
    if trust.misfit <= most:
        return []
    text = (
        f"points are more than {most:g} noise levels off the best hypothesis on average, "
        f"see the trust in the result: the sensor is less exact than {sensor_noise:g} m, the "
        "object is not quite this one, or a better pose was not found"
    )
    return [PointsWarning("above_noise", text)]


def most_error(redundancy: int, sensor_noise: float) -> float:
    """Return the mean error of points up to which a sensor's noise explains it, metres.

    redundancy: known points beyond those that a pose can fit.
    """
    return sensor_noise * (MOST_LEVELS_OF_MANY if redundancy >= MANY_BEYOND else MOST_LEVELS)


def correlation(points: FloatArray, errors: FloatArray) -> float:
    """Return the correlation of errors (N,) of points (N, 3) with those of nearest neighbours.

    Moran's I about 0, at most 1: near 0 for noise, and near 1 for a wrong shape, whose errors are
    those of whole sides. 0 for few points.
    """
    chosen = evenly_spaced(len(points), _MOST_CORRELATED)
    points, errors = points[chosen], errors[chosen]
    if len(points) < _LEAST_CORRELATED:
        return 0.0
    away = points[:, None] - points
    squared = away[..., 0] ** 2 + away[..., 1] ** 2 + away[..., 2] ** 2
    np.fill_diagonal(squared, np.inf)
    near = np.argsort(squared, axis=1, kind="stable")[:, :_NEIGHBOURS]
    squares = math.fsum((errors**2).tolist())
    products = math.fsum((errors[:, None] * errors[near]).ravel().tolist())
    return products / (_NEIGHBOURS * squares) if squares > 0.0 else 0.0


def has_pose(hypotheses: Hypotheses) -> bool:
    """Return whether the best hypothesis can be judged: it is there, and within FARTHEST."""
    poses = Poses.of(hypotheses.object_from_world[:1])
    return len(poses) > 0 and bool(_within(poses).all())


def _within(poses: Poses) -> BoolArray:
    """Return flags (B,) of poses without a number that is NaN or larger than kernels can read."""
    return np.asarray((np.abs(poses.numbers) <= FARTHEST).all(axis=1))


def _compared(hypotheses: Hypotheses) -> tuple[Poses, IntArray]:
    """Return the best hypotheses that repeat no other, and their indices."""
    if not has_pose(hypotheses):
        raise PoseError(
            "there is no hypothesis, or the best is not finite; accepted: at least one pose, "
            f"within {FARTHEST:g} m"
        )
    poses = Poses.of(hypotheses.object_from_world)
    chosen = _within(poses) & ~hypotheses.duplicate
    chosen[0] = True
    indices = np.flatnonzero(chosen)[:_MOST_HYPOTHESES]
    return poses[indices], indices


def _mean_error(
    problem: RegistrationProblem, pose: Poses, *, sensor_noise: float, most: float
) -> float:
    """Return the mean error of a pose, metres, of known points and others that contradict it.

    most: that a known point counts for. A free point contradicts a pose if it is deeper in the
    object than a voxel and noise explain, an occupied one if it is as far outside; it counts with
    its depth.
    """
    points, sdf = problem.points, problem.sdf
    off = np.abs(signed_distances(sdf, pose, points=points.known)[0] - points.sdf)
    tolerance = problem.free_resolution + LEAST_LEVELS * sensor_noise
    errors = [np.minimum(off, most)]
    for sign, group in ((-1.0, points.free), (1.0, points.occupied)):
        depths = sign * signed_distances(sdf, pose, points=group)[0]
        errors.append(depths[depths > tolerance])
    every = np.concatenate(errors)
    return float(in_order(every)) / max(len(every), 1)


def _components(adjacent: BoolArray) -> tuple[int, IntArray]:
    """Return the number of parts of a symmetric graph (K, K), and the part of each node (K,).

    As connected_components of scipy.sparse, whose import takes longer than a registration.
    """
    count = 0
    part = np.full(len(adjacent), -1)
    for first in range(len(adjacent)):
        if part[first] >= 0:
            continue
        reached = np.zeros(len(adjacent), dtype=np.bool_)
        newest = np.arange(len(adjacent)) == first
        while newest.any():
            reached |= newest
            newest = adjacent[newest].any(axis=0) & ~reached
        part[reached] = count
        count += 1
    return count, part


def motion_cost(
    problem: RegistrationProblem, pose: Poses, *, sensor_noise: float, distance: float
) -> float:
    """Return the rise of the energy, nats, if the object's surface moves by a distance, metres.

    It is that of the likeliest such motion, infinite if there is none. Up to LIMIT the points stay
    likely.
    A set of hypotheses may leave out what its method has not found. So the best pose is moved along
    the motions that contacts resist the least for how far they move the surface: the largest
    solutions of M v = lambda A v, with the mean squares v^T A v by which contacts leave the surface
    and v^T M v by which the surface leaves itself. Likely: by a likelihood ratio (Wilks, 1938), see
    `LIMIT`.
    """
    noise = noise_model(sensor_noise)
    motions = _loosest_motions(problem, pose, noise=noise)
    if len(motions) == 0:
        return math.inf
    moved = _moved(problem, pose, twists=distance * np.concatenate([motions, -motions]))
    energies = pose_energies(problem, Poses.joined([pose, moved]), noise=noise)
    # near for turns that are symmetries
    apart = distances_apart_from(problem.sdf, moved, other=pose)
    rises = energies[1:] - energies[0]
    return float(rises[apart >= 0.5 * distance].min(initial=math.inf))


def _loosest_motions(problem: RegistrationProblem, pose: Poses, *, noise: NoiseModel) -> FloatArray:
    """Return twists (K, 6) as `_moved` takes them, K at most 6, by which the surface moves by 1.

    A turn of a contact's normal counts as the distance that is as unlikely, at the middle level.
    """
    sdf, step = problem.sdf, 0.5 * problem.sdf.resolution
    nearby = _moved(problem, pose, twists=step * np.concatenate([np.eye(6), -np.eye(6)]))

    def products(points: FloatArray) -> FloatArray:
        """Return mean products (6, 6) of the rates at which distances of world points change."""
        distances = signed_distances(sdf, nearby, points=points)  # (12, N)
        rates = (distances[:6] - distances[6:]) / (2.0 * step)
        return in_order(rates[:, None] * rates) / max(len(points), 1)

    known = problem.points.known[evenly_spaced(len(problem.points.known), _MOST_KNOWN)]
    resisted = products(known) + _SOFT * np.eye(6)
    if problem.points.has_normals:
        level = noise.sigmas[len(noise.sigmas) // 2] / _arm(sdf)  # of a turn, as `_moved` takes it
        resisted[3:, 3:] += level**2 * _normal_products(problem.points, pose, noise=noise)
    metric = products(outline_in_world(sdf, pose)[0])
    motions = np.eye(6)
    for _ in range(_ROUNDS):
        motions = _solved(resisted, in_order(metric * motions[:, None]))
        motions = _orthonormal(motions, metric)
    return motions


def _normal_products(points: KnownPoints, pose: Poses, *, noise: NoiseModel) -> FloatArray:
    """Return means (3, 3) of (I - m m^T) / v over known points, of normals m of variance v."""
    variances = noise.normal_variances(points.normal_noise)
    normals = rotated(pose.rotations[0], points.normals)
    across = np.eye(3) - normals[:, :, None] * normals[:, None]
    weighted = np.where(variances > 0.0, 1.0 / np.where(variances > 0.0, variances, 1.0), 0.0)
    return in_order((weighted[:, None, None] * across).T) / len(variances)


def _orthonormal(vectors: FloatArray, metric: FloatArray) -> FloatArray:
    """Return vectors (K, 6) of length 1 by a metric (6, 6), orthogonal to those before.

    Vectors of next to no length are left out, such as turns that are symmetries of the object.
    """
    rows = metric.tolist()  # numbers of Python are faster than arrays of six
    result: list[list[float]] = []
    images: list[list[float]] = []  # of these, by the metric
    for vector in vectors.tolist():
        size = max(abs(value) for value in vector)
        for other, image in zip(result, images, strict=True):
            along = _dot(image, vector)
            vector = [value - along * part for value, part in zip(vector, other, strict=True)]
        length = math.sqrt(max(_dot([_dot(row, vector) for row in rows], vector), 0.0))
        if length > _LEAST_LENGTH * size:
            unit = [value / length for value in vector]
            result.append(unit)
            images.append([_dot(row, unit) for row in rows])
    return np.array(result).reshape(-1, 6)


def _dot(one: list[float], other: list[float]) -> float:
    """Return the inner product of two vectors, added in order."""
    total = one[0] * other[0]
    for n in range(1, len(one)):
        total += one[n] * other[n]
    return total


def _moved(problem: RegistrationProblem, pose: Poses, *, twists: FloatArray) -> Poses:
    """Return a pose after motions (K, 6) of the object: shifts, and turns about its middle, metres.

    Turns are lengths of arc at half a diameter.
    """
    centre = problem.sdf.bounds.mean(axis=0)
    turn = rotation_vector(twists[:, 3:] / _arm(problem.sdf))
    shift = centre + twists[:, :3] - rotated(turn, centre)
    turned = product(turn, np.broadcast_to(pose.rotations, turn.shape))
    return Poses.of(compose(turned, rotated(turn, pose.translations) + shift))


def _arm(sdf: SdfGrid) -> float:
    """Return the length at which arcs of turns are measured, metres."""
    return max(0.5 * sdf.diameter, sdf.resolution)


def pose_energies(problem: RegistrationProblem, poses: Poses, *, noise: NoiseModel) -> FloatArray:
    """Return minus the log-likelihood (B,) of the points in poses, nats, see `chsel.problem.noise`.

    With a prior it is minus the log of the posterior density. Some of many points represent all;
    those left out count for nothing.
    """
    points, sdf = problem.points, problem.sdf
    known = evenly_spaced(len(points.known), _MOST_KNOWN)
    residuals = signed_distances(sdf, poses, points=points.known[known]) - points.sdf[known]
    free, occupied = (
        group[evenly_spaced(len(group), _MOST_FREE)] for group in (points.free, points.occupied)
    )
    depths = [
        -signed_distances(sdf, poses, points=free),
        signed_distances(sdf, poses, points=occupied),
    ]
    normals = (
        posed_normals(sdf, points.with_known(known), poses=poses) if points.has_normals else None
    )
    energies = noise.energies(residuals, np.concatenate(depths, axis=1), normals=normals)
    return energies if problem.prior is None else energies + problem.prior.energies(poses, sdf)


def posed_normals(sdf: SdfGrid, points: KnownPoints, *, poses: Poses) -> PosedNormals:
    """Return the normals of known points beside those of the object in poses (B, 12)."""
    gradients = surface_gradients(sdf, poses, points=points.known)
    turned_normals = rotated(poses.rotations[:, None], points.normals)
    lengths = np.sqrt(in_order(gradients * gradients))
    cosines = in_order(turned_normals * gradients) / np.maximum(lengths, _LEAST_GRADIENT)
    return PosedNormals(points.normal_noise, cosines, lengths=lengths)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return solutions x (K, 6) of matrix x = right (K, 6), positive definite, by elimination."""
    rows = np.concatenate([matrix, right.T], axis=1)  # (6, 6 + K)
    for i in range(6):
        rows[i] = rows[i] / rows[i, i]
        for j in range(6):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return np.ascontiguousarray(rows[:, 6:].T)
