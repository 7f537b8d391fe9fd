"""The vectors that optimizers search: 9-D for SE(3), 3-D for an object on a plane."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.numerics.cell_set import triple
from chsel.numerics.elementary import arctangents
from chsel.numerics.pose_tuples import SpaceConstants, decode_all, matrix_of
from chsel.problem.points import Workspace
from chsel.problem.poses import Poses, hat, product, rotated, rotation_vector, twice_sine_axis
from chsel.problem.sdf_grid import SdfGrid


class SearchSpace(ABC):
    """Vectors x (B, d) that represent poses."""

    dimension: int  # d
    arrays: SpaceConstants  # for kernels

    @abstractmethod
    def encode(self, poses: Poses) -> FloatArray:
        """Return vectors (B, d) of poses, or of the nearest poses in the space."""

    def poses(self, vectors: FloatArray) -> Poses:
        """Return the poses of vectors (B, d)."""
        numbers = np.empty((len(vectors), 12))
        decode_all(self.arrays, np.array(vectors, dtype=np.float64), poses=numbers)
        return Poses(numbers)


class SE3Space(SearchSpace):
    """x = [first row of R, second row of R, t] (CHSEL, Sec. IV-C)."""

    dimension = 9
    arrays = SpaceConstants()

    def encode(self, poses: Poses) -> FloatArray:
        """Return the 9-D vectors of poses."""
        return poses.vectors


@dataclass(frozen=True)
class PlaneSettings:
    """An object that stands on a plane and only turns and slides on it.

    Either plane_height or offset is required, and not both.
    """

    # Normal of the plane in the frame of the resting object; it is normalised.
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    # R_0 of an object that does not stand upright: rotation vector of object_from_world, radians.
    resting_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    plane_height: float | None = None  # above the world's origin along the normal, metres
    offset: float | None = None  # o = axis . t of object_from_world, metres

    def __post_init__(self) -> None:
        axis = frozen("plane.axis", self.axis, shape=(3,), error=SettingError)
        if not (axis**2).sum() > 1e-12:
            raise SettingError(f"axis is {self.axis}; accepted: a vector that is not zero")
        if (self.plane_height is None) == (self.offset is None):
            raise SettingError("a plane needs either plane_height or offset, and not both")


class SE2Space(SearchSpace):
    """x = [theta, u, v]: R = Rot(a, theta) R_0, t = o a + u e_u + v e_v."""

    dimension = 3

    def __init__(self, settings: PlaneSettings, sdf: SdfGrid) -> None:
        axis = np.array(settings.axis)
        axis = axis / np.sqrt((axis**2).sum())
        along_z = abs(abs(axis[2]) - 1.0) < 1e-9
        other = np.array([0.0, -1.0, 0.0]) if along_z else np.array([0.0, 0.0, -1.0])
        e_u = np.cross(axis, other)
        e_u = e_u / np.sqrt((e_u**2).sum())
        offset = settings.offset
        if offset is None:
            assert settings.plane_height is not None
            offset = _lowest_point(sdf, axis) - settings.plane_height
        self.axis = axis
        self.e_u = e_u
        self.e_v = np.cross(axis, e_u)
        self.offset = offset
        self.resting_rotation = rotation_vector(np.array(settings.resting_rotation))
        hat_squared = np.outer(axis, axis) - np.eye(3)
        self.arrays = SpaceConstants(
            planar=True,
            axis=triple(axis),
            e_u=triple(e_u),
            e_v=triple(self.e_v),
            resting=matrix_of(self.resting_rotation),
            turning=matrix_of(product(hat(axis), self.resting_rotation)),
            turning_squared=matrix_of(product(hat_squared, self.resting_rotation)),
            offset=float(offset),
        )

    @property
    def upward(self) -> FloatArray:
        """The plane's normal in the world (3,): R^T a, the same for every pose."""
        return (self.resting_rotation * self.axis[:, None]).sum(axis=0)

    def encode(self, poses: Poses) -> FloatArray:
        """Return the vectors of the nearest poses on the plane by the Frobenius norm."""
        turned = product(poses.rotations, self.resting_rotation.T)
        sine = (twice_sine_axis(turned) * self.axis).sum(axis=1)
        along = (rotated(turned, self.axis) * self.axis).sum(axis=1)
        theta = arctangents(sine, np.trace(turned, axis1=1, axis2=2) - along)
        u, v = ((poses.translations * axis).sum(axis=1) for axis in (self.e_u, self.e_v))
        return np.stack([theta, u, v], axis=1)


def search_space(plane: PlaneSettings | None, sdf: SdfGrid) -> SearchSpace:
    """Return SE(3), or SE(2) on a plane."""
    return SE3Space() if plane is None else SE2Space(plane, sdf)


def origin_bounds(
    workspace: Workspace, space: SearchSpace, *, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Return bounds (3,) of the object's origin: the workspace plus a margin in metres.

    For an object on a plane, the margin grows until the bounds meet the plane.
    """
    lower, upper = workspace.bounds
    if isinstance(space, SE2Space):
        upward = space.upward
        corners = np.where(upward > 0.0, lower, upper), np.where(upward > 0.0, upper, lower)
        lowest, highest = (float((corner * upward).sum()) for corner in corners)
        margin += max(lowest + space.offset, -space.offset - highest, 0.0)
    return lower - margin, upper + margin


def _lowest_point(sdf: SdfGrid, axis: FloatArray) -> float:
    """Return the least a . x on the object's surface, from the grid's nodes near the surface."""
    near = np.abs(sdf.values) < 2.0 * sdf.resolution
    nodes = sdf.origin + np.argwhere(near) * sdf.resolution
    surface = nodes - sdf.values[near][:, None] * sdf.gradients[near]
    return float((surface * axis).sum(axis=1).min())
