"""Poses and rigid transforms, then rotations, then quaternions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from chsel.errors import PoseError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.elementary import arctangents, sines_cosines
from chsel.problem.streams import normals

RIGID_TOLERANCE = 1e-6
SENSOR_TOLERANCE = 1e-3  # of poses from files and sensors, which are often rounded
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]  # the axes behind each, in a circle
_SMALL = 1e-6  # radians, below which a straight line is as good as an arc


@dataclass(frozen=True, eq=False)
class Poses:
    """B poses of an object, object_from_world: x_object = R x_world + t (the paper's T).

    Views are computed when they are first asked for, once.
    """

    numbers: FloatArray  # (B, 12), R row by row, then t in metres, as the kernels read them

    @classmethod
    def of(cls, object_from_world: Any) -> Poses:
        """Return the poses of transforms (B, 4, 4), finite or not; PoseError for another shape."""
        transforms = stacked(object_from_world)
        rotations = transforms[:, :3, :3].reshape(-1, 9)
        return cls(np.concatenate([rotations, transforms[:, :3, 3]], axis=1))

    @classmethod
    def joined(cls, parts: Sequence[Poses]) -> Poses:
        """Return the poses of several parts, at least one, in their order."""
        return cls(np.concatenate([part.numbers for part in parts]))

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, chosen: Any) -> Poses:
        """Return the chosen poses: a slice, flags (B,) or indices (C,)."""
        return Poses(self.numbers[chosen])

    @property
    def rotations(self) -> FloatArray:
        """R (B, 3, 3)."""
        return self.numbers[:, :9].reshape(-1, 3, 3)

    @property
    def translations(self) -> FloatArray:
        """t (B, 3), metres."""
        return self.numbers[:, 9:]

    @cached_property
    def matrices(self) -> FloatArray:
        """Transforms object_from_world (B, 4, 4)."""
        return compose(self.rotations, self.translations)

    @cached_property
    def world_from_object(self) -> FloatArray:
        """The inverse transforms (B, 4, 4)."""
        return inverse(self.matrices)

    @property
    def origins(self) -> FloatArray:
        """The object's origins in the world (B, 3), metres: -R^T t."""
        return -rotated(np.swapaxes(self.rotations, 1, 2), self.translations)

    @cached_property
    def vectors(self) -> FloatArray:
        """The 9-D vectors (B, 9): the first two rows of R, then t (CHSEL, Sec. IV-B)."""
        return np.concatenate([self.numbers[:, :6], self.translations], axis=1)


def stacked(object_from_world: Any) -> FloatArray:
    """Return transforms (B, 4, 4) as an array, finite or not; PoseError for another shape."""
    transforms = np.asarray(object_from_world, dtype=np.float64)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4):
        raise PoseError(
            f"object_from_world has shape {transforms.shape}; accepted: (any, 4, 4), several poses"
        )
    return transforms


def check_rigid(name: str, transforms: FloatArray, *, tolerance: float = RIGID_TOLERANCE) -> None:
    """Raise PoseError unless every (4, 4) of transforms (B, 4, 4) is a rotation and translation."""
    rows = np.ascontiguousarray(transforms[:, :3, :3].transpose(1, 2, 0))  # (3, 3, B)
    products = (rows[[0, 1, 2, 0, 0, 1]] * rows[[0, 1, 2, 1, 2, 2]]).sum(axis=1)  # (6, B)
    products[:3] -= 1.0  # of each row with itself
    x, y, z = rows
    handed = ((x[_NEXT] * y[_AFTER] - x[_AFTER] * y[_NEXT]) * z).sum(axis=0)
    good = (np.abs(products).max(axis=0, initial=0.0) < tolerance) & (handed > 0)
    good &= (transforms[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    if not good.all():
        index = int(np.argmin(good))
        raise PoseError(
            f"{name}[{index}] is not a rigid transform; accepted: a (4, 4) matrix of a rotation "
            "matrix (determinant +1), a translation, and the last row 0 0 0 1"
        )


def nearest_rigid(name: str, transforms: FloatArray) -> FloatArray:
    """Return transforms (B, 4, 4) with the nearest exact rotations, for numbers rounded in a file.

    Raises PoseError unless they are rigid within 1e-3.
    """
    check_rigid(name, transforms, tolerance=SENSOR_TOLERANCE)
    left, _, right = np.linalg.svd(transforms[:, :3, :3])
    return compose(left @ right, transforms[:, :3, 3])


def compose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    transforms = np.zeros((*rotation.shape[:-2], 4, 4))
    transforms[..., :3, :3] = rotation
    transforms[..., :3, 3] = translation
    transforms[..., 3, 3] = 1.0
    return transforms


def inverse(transforms: FloatArray) -> FloatArray:
    """Return the inverse of rigid transforms (..., 4, 4)."""
    rotation = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return compose(rotation, -rotated(rotation, transforms[..., :3, 3]))


def apply(transforms: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) moved by transforms (..., 4, 4): (..., N, 3)."""
    moved = np.einsum("...ij,nj->...ni", transforms[..., :3, :3], points)
    return moved + transforms[..., None, :3, 3]


def interpolated(first: FloatArray, second: FloatArray, *, fraction: FloatArray) -> FloatArray:
    """Return transforms (N, 4, 4) at fractions (N,) of the way from first to second (N, 4, 4)."""
    t = np.asarray(fraction, dtype=np.float64)[:, None]
    position = (1.0 - t) * first[:, :3, 3] + t * second[:, :3, 3]
    turned = slerp(quaternions(first[:, :3, :3]), quaternions(second[:, :3, :3]), fraction=fraction)
    return compose(rotation_matrices(turned), position)


def product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return matrix products (..., 3, 3) of (..., 3, 3), each sum in the order of its index."""
    total = left[..., :, 0, None] * right[..., None, 0, :]
    total = total + left[..., :, 1, None] * right[..., None, 1, :]
    return total + left[..., :, 2, None] * right[..., None, 2, :]


def rotated(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 3) times rotations (..., 3, 3), sums in the order of indices."""
    total = rotation[..., 0] * vectors[..., 0, None]
    total = total + rotation[..., 1] * vectors[..., 1, None]
    return total + rotation[..., 2] * vectors[..., 2, None]


def axis_angle(axis: FloatArray, angle: FloatArray | float) -> FloatArray:
    """Return rotations (..., 3, 3) about unit axes (..., 3) by angles (...), radians."""
    sine, cosine = (values[..., None, None] for values in sines_cosines(angle))
    outer = axis[..., :, None] * axis[..., None, :]
    return cosine * np.eye(3) + sine * hat(axis) + (1.0 - cosine) * outer


def hat(vectors: FloatArray) -> FloatArray:
    """Return the matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2] = -vectors[..., 2], vectors[..., 1]
    matrices[..., 1, 0], matrices[..., 1, 2] = vectors[..., 2], -vectors[..., 0]
    matrices[..., 2, 0], matrices[..., 2, 1] = -vectors[..., 1], vectors[..., 0]
    return matrices


def roll_pitch_yaw(angles: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) by angles (3,), radians, about the fixed axes x, y, z in order."""
    about_x, about_y, about_z = axis_angle(np.eye(3), np.asarray(angles, dtype=np.float64))
    return product(product(about_z, about_y), about_x)


def rotation_vector(vectors: FloatArray) -> FloatArray:
    """Return rotations (..., 3, 3) of rotation vectors (..., 3): the exponential map of SO(3)."""
    angle = np.sqrt((vectors**2).sum(axis=-1))
    safe = np.where(angle > 0.0, angle, 1.0)
    axis = np.where(angle[..., None] > 0.0, vectors / safe[..., None], [1.0, 0.0, 0.0])
    return axis_angle(axis, angle)


def rotation_vectors(rotation: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3) of rotations (N, 3, 3), up to pi radians long.

    The inverse of `rotation_vector`, as accurate at turns by nearly pi as at small ones.
    """
    quaternion = quaternions(rotation)
    quaternion = np.where(quaternion[:, 3:] < 0.0, -quaternion, quaternion)
    size = np.sqrt((quaternion[:, :3] ** 2).sum(axis=1))
    angle = 2.0 * arctangents(size, quaternion[:, 3])
    return quaternion[:, :3] * (angle / np.where(size > 0.0, size, 1.0))[:, None]


def random_rotations(stream: np.random.Generator, count: int) -> FloatArray:
    """Return rotations (count, 3, 3), uniform on SO(3): normalised Gaussian quaternions."""
    drawn = normals(stream, (count, 4))  # w x y z
    unit = drawn / np.sqrt((drawn**2).sum(axis=1, keepdims=True))
    return rotation_matrices(unit[:, [1, 2, 3, 0]])


def rotation_angle(rotation: FloatArray) -> FloatArray:
    """Return angles (...), radians, of rotations (..., 3, 3), in [0, pi], also of small ones."""
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return arctangents(np.sqrt((twice_sine_axis(rotation) ** 2).sum(axis=-1)), trace - 1.0)


def twice_sine_axis(rotation: FloatArray) -> FloatArray:
    """Return 2 sin(angle) axis (..., 3) of rotations (..., 3, 3): their skew part."""
    r = np.moveaxis(rotation, (-2, -1), (0, 1))
    return np.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]], axis=-1)


def quaternions(rotation: FloatArray) -> FloatArray:
    """Return unit quaternions (N, 4), x y z w, of rotations (N, 3, 3); their sign is arbitrary.

    Each row of the outer product of a quaternion with itself is a multiple of it, and its entries
    follow from the rotation without a root; the row with the largest diagonal entry is used, as it
    is the most accurate.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotation, 0, -1)
    outer = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )  # (4, 4, N)
    largest = np.argmax(np.diagonal(outer), axis=1)
    rows = np.moveaxis(outer, -1, 0)[np.arange(len(rotation)), largest]
    unit: FloatArray = rows / np.sqrt((rows**2).sum(axis=1, keepdims=True))
    return unit


def rotation_matrices(quaternion: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) of unit quaternions (N, 4), x y z w."""
    x, y, z, w = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def slerp(first: FloatArray, second: FloatArray, *, fraction: FloatArray) -> FloatArray:
    """Return unit quaternions (N, 4) at fractions (N,) of the arcs from first to second (N, 4).

    q(t) = (sin((1 - t) a) p + sin(t a) q) / sin a, with the angle a between p and q or -q.
    """
    t = np.asarray(fraction, dtype=np.float64)[:, None]
    second = np.where(_product(first, second) < 0.0, -second, second)
    apart, joint = second - first, second + first
    a = 2.0 * arctangents(np.sqrt(_product(apart, apart)), np.sqrt(_product(joint, joint)))
    arc = a > _SMALL
    before = np.where(arc, sines_cosines((1.0 - t) * a)[0], 1.0 - t)
    after = np.where(arc, sines_cosines(t * a)[0], t)
    between = before * first + after * second
    unit: FloatArray = between / np.sqrt(_product(between, between))
    return unit


def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return inner products (N, 1) of vectors (N, 4), summed in a fixed order."""
    terms = left * right
    return ((terms[:, 0] + terms[:, 1]) + (terms[:, 2] + terms[:, 3]))[:, None]
