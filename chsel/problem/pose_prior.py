"""A prior on the pose of an object: what is known of it before any point is.

    E(X) = -log((1 - w) exp(-q(X)) + w),    w = exp(-WRONG)
    q(X) = |R c + t - p|^2 / (2 s_c^2)  +  2 (1 - (R l) . a) / s_a^2  -  log min(sum_j g_j(X), 1)

in nats: 0 where the prior has the object, and at most WRONG, so that points which contradict it
decide where the object is. WRONG is more than the LIMIT of `chsel.problem.noise`, or sets would be
full of poses that ignore the prior. A world point c is the object's point p, a world direction l is
the object's axis a, and g_j are Gaussians about the poses of another estimator, in units of the
highest that their sum is at one of these poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from chsel.errors import (
    PoseError,
    SettingError,
    quoted,
    require_between,
    require_instance,
    require_positive,
)
from chsel.numerics.arrays import FloatArray, ShapesShown, digest, frozen
from chsel.numerics.elementary import arctangents, exps, logs
from chsel.problem.points import FARTHEST_PLACE
from chsel.problem.poses import (
    Poses,
    check_rigid,
    product,
    rotated,
    rotation_angle,
    rotation_vectors,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.surface import has_surface, in_order, object_centre

WRONG = 12.0  # nats
LEAST_NOISE = 1e-9  # metres or radians: less is taken for a mistake
MOST_POSES = 200  # of another estimator: every energy looks at all of them
SURE = 5.0  # nats beyond the mean cost of a right prior, above which the points contradict it
_ROUNDED = 1e-14  # by which squares of unit vectors and sums of weights are off after division
_SYMMETRIC = 1e-6  # by which a covariance may be asymmetric, relative
_LEAST_PIVOT = 1e-9  # of a covariance, relative to its diagonal


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PosePrior(ShapesShown):
    """What is known of the pose of an object before it is touched: at least one of three parts.

    The parts are independent of each other: a Gaussian on a point of the object (`centre`), a cone
    about an axis (`axis`), and the poses of another estimator (`object_from_world`).
    Raises SettingError for a part that is incomplete or out of range, and PoseError for poses and
    covariances that are none.
    """

    centre: FloatArray | None = None  # (3,), world, metres: where `point` is
    centre_noise: float | None = None  # standard deviation along each axis, metres
    point: FloatArray | None = None  # (3,), object frame, metres; None: the object's centre
    axis: FloatArray | None = None  # (3,), object frame; any length above 0, kept as unit vector
    along: FloatArray | None = None  # (3,), world: the direction of `axis`; kept as unit vector
    axis_noise: float | None = None  # root mean square of the angle between them, radians
    object_from_world: FloatArray | None = None  # (J, 4, 4): poses of another estimator
    # (J, 6, 6), or (6, 6) for every pose: of the object's centre (metres), then of the rotation
    # vector (radians), both in world axes, as those of the modes of `chsel.PoseBelief`.
    covariances: FloatArray | None = None
    weights: FloatArray | None = None  # (J,), above 0, kept with the sum 1; None: equal

    def __post_init__(self) -> None:
        self._require_together("centre", "centre_noise", optional=("point",))
        self._require_together("axis", "along", "axis_noise")
        self._require_together("object_from_world", "covariances", optional=("weights",))
        if self.centre is None and self.axis is None and self.object_from_world is None:
            raise SettingError("the prior is empty; accepted: centre, axis or object_from_world")
        for name in ("centre", "point", "axis", "along"):
            if getattr(self, name) is not None:
                self._set(name, _vector(name, getattr(self, name)))
        for name in ("axis", "along"):
            if getattr(self, name) is not None:
                self._set(name, _unit(name, getattr(self, name)))
        for name in ("centre_noise", "axis_noise"):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name))
                self._set(name, float(getattr(self, name)))
        if self.centre_noise is not None:
            require_between("centre_noise", self.centre_noise, low=LEAST_NOISE, high=FARTHEST_PLACE)
        if self.axis_noise is not None and not LEAST_NOISE <= self.axis_noise <= math.pi:
            doubt = ": in degrees?" if self.axis_noise > math.pi else ";"
            raise SettingError(
                f"axis_noise is {self.axis_noise:g}{doubt} accepted: {LEAST_NOISE:g} to pi, radians"
            )
        if self.object_from_world is not None:
            self._set_poses(self.object_from_world, self.covariances, weights=self.weights)

    def _require_together(self, *names: str, optional: tuple[str, ...] = ()) -> None:
        """Raise SettingError unless all of these fields are given, or none of them."""
        missing = [name for name in names if getattr(self, name) is None]
        given = [name for name in (*names, *optional) if getattr(self, name) is not None]
        if missing and given:
            raise SettingError(
                f"the prior has {', '.join(given)} without {', '.join(missing)}; accepted: "
                f"{', '.join(names)} together"
            )

    def _set_poses(self, given: Any, covariances: Any, *, weights: Any) -> None:
        poses = frozen("object_from_world", given, shape=(None, 4, 4), error=PoseError)
        count = len(poses)
        if not 1 <= count <= MOST_POSES:
            raise PoseError(f"object_from_world has {count} poses; accepted: 1 to {MOST_POSES}")
        check_rigid("object_from_world", poses)
        if np.ndim(covariances) == 2:
            covariances = np.broadcast_to(np.asarray(covariances), (count, *np.shape(covariances)))
        covariances = frozen("covariances", covariances, shape=(count, 6, 6), error=PoseError)
        _check_covariances(covariances)
        weights = np.full(count, 1.0 / count) if weights is None else weights
        weights = frozen("weights", weights, shape=(count,), error=SettingError)
        if not (weights > 0.0).all():
            raise SettingError(f"weights has {weights.min():g}; accepted: above 0")
        total = float(in_order(weights))
        if abs(total - 1.0) > count * _ROUNDED:
            weights = frozen("weights", weights / total, shape=(count,))
        self._set("object_from_world", poses)
        self._set("covariances", covariances)
        self._set("weights", weights)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @cached_property
    def digest(self) -> str:
        """Digest of all fields."""
        values = [getattr(self, field.name) for field in fields(self)]
        return digest(*[np.atleast_1d([] if each is None else each) for each in values])

    @property
    def freedoms(self) -> int:
        """Number of independent Gaussian errors: 3 of a point, 2 of an axis, 6 of a pose."""
        parts = ((self.centre, 3), (self.axis, 2), (self.object_from_world, 6))
        return sum(count for value, count in parts if value is not None)

    @cached_property
    def whitening(self) -> FloatArray:
        """Matrices (J, 6, 6), lower triangular, by which offsets from poses are standard normal."""
        assert self.covariances is not None
        return _inverse_lower(_cholesky(self.covariances)[0])

    def energies(self, poses: Poses, sdf: SdfGrid) -> FloatArray:
        """Return E (B,) of poses, nats: the same bits on every machine. sdf: of the object."""
        wrong = exps(-WRONG)
        right = (1.0 - wrong) * exps(-self.quadratic_costs(poses, sdf))
        if self.object_from_world is not None:
            right = right * np.minimum(self.mixture(poses, sdf), 1.0)
        return -logs(right + wrong)

    def quadratic_costs(self, poses: Poses, sdf: SdfGrid) -> FloatArray:
        """Return the part of q (B,), nats, that is due to `centre` and `axis`."""
        costs = np.zeros(len(poses))
        if self.centre is not None and self.centre_noise is not None:
            off = rotated(poses.rotations, self.centre) + poses.translations - self.point_on(sdf)
            costs = costs + 0.5 * in_order(off**2) / self.centre_noise**2
        if self.axis is not None and self.along is not None and self.axis_noise is not None:
            off = rotated(poses.rotations, self.along) - self.axis
            costs = costs + in_order(off**2) / self.axis_noise**2  # |m - a|^2 = 2 (1 - m . a)
        return costs

    def mixture(self, poses: Poses, sdf: SdfGrid) -> FloatArray:
        """Return sum_j g_j (B,) of the poses of another estimator."""
        return in_order(self.densities(sdf) * exps(-0.5 * self._squares(poses, sdf)))

    def densities(self, sdf: SdfGrid) -> FloatArray:
        """Return g_j (J,), each at its own pose."""
        assert self.weights is not None
        values = np.array(self.weights)
        diagonals = np.diagonal(self.whitening, axis1=1, axis2=2)  # (J, 6)
        for i in range(6):
            values = values * (diagonals[:, i] / diagonals[:, i].max())
        sums = in_order(values * exps(-0.5 * self._squares(self._others, sdf)))
        return np.asarray(values / sums.max())

    def _squares(self, poses: Poses, sdf: SdfGrid) -> FloatArray:
        """Return squared Mahalanobis distances (B, J) of poses from those of another estimator."""
        offsets = self._offsets(poses, sdf)
        total = np.zeros(offsets.shape[:2])
        for k in range(6):
            total = total + in_order(self.whitening[:, k, : k + 1] * offsets[..., : k + 1]) ** 2
        return total

    def _offsets(self, poses: Poses, sdf: SdfGrid) -> FloatArray:
        """Return how poses are off those of another estimator (B, J, 6), see `covariances`."""
        shifts = _places(poses, centre_of(sdf))[:, None] - self.centres(sdf)
        turns = product(np.swapaxes(poses.rotations, 1, 2)[:, None], self._others.rotations)
        vectors = rotation_vectors(turns.reshape(-1, 3, 3)).reshape(shifts.shape)
        return np.concatenate([shifts, vectors], axis=-1)

    @property
    def _others(self) -> Poses:
        assert self.object_from_world is not None
        return Poses.of(self.object_from_world)

    def centres(self, sdf: SdfGrid) -> FloatArray:
        """Return the object's centres (J, 3) in the poses of another estimator, world, metres."""
        return _places(self._others, centre_of(sdf))

    def point_on(self, sdf: SdfGrid) -> FloatArray:
        """Return the point (3,) of the object, its frame, metres."""
        return centre_of(sdf) if self.point is None else self.point

    def shifted(self, shift: FloatArray) -> PosePrior:
        """Return the prior on an object that has been moved by a shift (3,), world, metres."""
        parts: dict[str, Any] = {}
        if self.centre is not None:
            parts["centre"] = self.centre + shift
        if self.object_from_world is not None:
            poses = self.object_from_world.copy()
            poses[:, :3, 3] -= rotated(poses[:, :3, :3], shift)
            parts["object_from_world"] = poses
        return replace(self, **parts)

    def offset(self, pose: Poses, sdf: SdfGrid) -> tuple[float | None, float | None]:
        """Return how far one pose is off: metres and radians, None for what no part says.

        From the nearest of the poses of another estimator. Of several parts, the largest.
        """
        metres: list[float] = []
        radians: list[float] = []
        if self.centre is not None:
            off = rotated(pose.rotations, self.centre) + pose.translations - self.point_on(sdf)
            metres.append(math.sqrt(float(in_order(off**2)[0])))
        if self.along is not None and self.axis is not None:
            turned = rotated(pose.rotations, self.along)[0]
            sine = math.sqrt(float(in_order(np.cross(turned, self.axis) ** 2)))
            radians.append(float(arctangents(sine, float(in_order(turned * self.axis)))))
        if self.object_from_world is not None:
            nearest = int(np.argmin(self._squares(pose, sdf)[0]))
            shift = self._offsets(pose, sdf)[0, nearest, :3]
            other = self.object_from_world[nearest, :3, :3]
            metres.append(math.sqrt(float(in_order(shift**2))))
            radians.append(float(rotation_angle(product(pose.rotations[0], other.T))))
        return max(metres, default=None), max(radians, default=None)

    def is_contradicted(self, pose: Poses, sdf: SdfGrid) -> bool:
        """Return whether one pose costs more than SURE nats beyond what a right prior costs."""
        cost = self.quadratic_costs(pose, sdf)[0]
        if self.object_from_world is not None:
            cost = cost - logs(np.minimum(self.mixture(pose, sdf), 1.0))[0]
        return bool(cost > SURE + 0.5 * self.freedoms)


def prior_from_settings(name: str, given: Any) -> PosePrior | None:
    """Return the prior of a mapping from fields to plain values, as files of settings have it.

    name: of the mapping, in errors. None: no prior. Raises SettingError for anything else.
    """
    if given is None:
        return None
    accepted = [field.name for field in fields(PosePrior)]
    if not isinstance(given, Mapping):
        shown = quoted(given)
        raise SettingError(f"{name} is {shown}; accepted: a mapping of {', '.join(accepted)}")
    for field in given:
        if field not in accepted:
            raise SettingError(f"{name}.{field} does not exist; accepted: {', '.join(accepted)}")
    try:
        return PosePrior(**given)
    except (SettingError, PoseError) as error:
        raise SettingError(f"{name}: {error}") from None


def require_prior(given: object) -> None:
    """Raise SettingError unless this is a prior."""
    accepted = "chsel.PosePrior(centre=, centre_noise=) and such, or None"
    require_instance("prior", given, kind=PosePrior, accepted=accepted)


def centre_of(sdf: SdfGrid) -> FloatArray:
    """Return the centre (3,) of an object, its frame, metres."""
    return object_centre(sdf) if has_surface(sdf) else np.asarray(sdf.bounds.mean(axis=0))


def _places(poses: Poses, point: FloatArray) -> FloatArray:
    """Return where a point (3,) of the object is in poses: (B, 3), world, metres."""
    return rotated(np.swapaxes(poses.rotations, 1, 2), point - poses.translations)


def _vector(name: str, value: Any) -> FloatArray:
    return frozen(name, value, shape=(3,), error=SettingError, most=FARTHEST_PLACE)


def _unit(name: str, value: FloatArray) -> FloatArray:
    """Return a vector (3,) over its length; unit vectors as they are, so that digests stay."""
    square = float(in_order(value**2))
    if not square > 0.0:
        raise SettingError(f"{name} is 0; accepted: a direction")
    if abs(square - 1.0) <= _ROUNDED:
        return value
    return _vector(name, value / math.sqrt(square))


def _check_covariances(covariances: FloatArray) -> None:
    """Raise PoseError unless covariances (J, 6, 6) are symmetric and positive definite."""
    sizes = np.abs(covariances).max(axis=(1, 2))
    asymmetry = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    definite = _cholesky(covariances)[1]
    good = definite & (asymmetry <= _SYMMETRIC * sizes)
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    within = (variances >= LEAST_NOISE**2) & (variances <= FARTHEST_PLACE**2)
    if good.all() and not within.all():
        j, i = np.argwhere(~within)[0].tolist()
        raise PoseError(
            f"covariances[{j}, {i}, {i}] is {variances[j, i]:.3g}; accepted: squares of "
            f"{LEAST_NOISE:g} to {FARTHEST_PLACE:g}, metres and radians"
        )
    if not good.all():
        raise PoseError(
            f"covariances[{int(np.argmin(good))}] is not a covariance; accepted: a symmetric, "
            "positive definite matrix (6, 6), so with an error in every direction"
        )


def _cholesky(matrices: FloatArray) -> tuple[FloatArray, Any]:
    """Return lower triangles L (J, 6, 6) of L L^T, and flags (J,) of positive definite matrices."""
    lower = np.zeros(matrices.shape)
    definite = np.ones(len(matrices), dtype=bool)
    for i in range(6):
        for j in range(i + 1):
            left = matrices[:, i, j] - in_order(lower[:, i, :j] * lower[:, j, :j])
            if i == j:
                definite &= left > _LEAST_PIVOT * np.abs(matrices[:, i, i])
                lower[:, i, i] = np.sqrt(np.where(definite, left, 1.0))
            else:
                lower[:, i, j] = left / lower[:, j, j]
    return lower, definite


def _inverse_lower(lower: FloatArray) -> FloatArray:
    """Return the inverses of lower triangular matrices (J, 6, 6)."""
    result = np.zeros(lower.shape)
    for j in range(6):
        for i in range(j, 6):
            right = (1.0 if i == j else 0.0) - in_order(lower[:, i, j:i] * result[:, j:i, j])
            result[:, i, j] = right / lower[:, i, i]
    return result
