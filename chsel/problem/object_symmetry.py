"""Rotations after which an object counts as the same: found on its surface, or declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from chsel.errors import PoseError, SettingError, quoted
from chsel.numerics.arrays import FloatArray, digest, frozen
from chsel.numerics.elementary import arctangents
from chsel.problem.poses import (
    Poses,
    axis_angle,
    compose,
    hat,
    nearest_rigid,
    product,
    rotated,
    rotation_angle,
)

LARGEST_GROUP = 60  # the icosahedron's; a larger one cannot be distinguished from revolution
_SAME_DECLARED = np.deg2rad(1.0)  # between two declarations of one rotation
_SAME_PLACE = 1e-4  # metres between centres of declared rotations, and this share of their shifts:
_SAME_SHARE = 0.01
_IMPROVEMENTS = 5


@dataclass(frozen=True, eq=False)
class ObjectSymmetry:
    """The symmetries of an object: proper rotations about its centre, in the object's frame.

    They are `rotations` if there is no axis of revolution, their products with the rotations by all
    angles about the axis if there is one, and all rotations for a sphere. By default the identity
    alone, about the origin of the object's frame: the object has no symmetry.
    """

    centre: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,), m
    rotations: FloatArray = field(default_factory=lambda: np.eye(3)[None])  # (S, 3, 3)
    axis: FloatArray | None = None  # (3,), unit, of revolution
    sphere: bool = False  # whether all rotations are symmetries

    @classmethod
    def declared(cls, *, turns: Any = (), axes: Any = ()) -> ObjectSymmetry:
        """Return the symmetries that turns and axes of revolution generate.

        turns (T, 4, 4): motions of the object's frame, metres. axes (K, 2, 3): the direction of
        each and a point on it. The identity needs no mention.
        Raise SettingError where they have no common centre, or are no group of at most 60.
        """
        turns = frozen("turns", turns, shape=(None, 4, 4), error=SettingError)
        turns = nearest_rigid("turns", turns) if len(turns) else turns
        axes = frozen("axes", axes, shape=(None, 2, 3), error=SettingError)
        lengths = np.sqrt((axes[:, 0] ** 2).sum(axis=1))
        if not (lengths > 0.0).all():
            raise SettingError("axes have a direction of length 0; accepted: any other vector")
        directions = axes[:, 0] / lengths[:, None]
        centre = _common_centre(turns, directions, points=axes[:, 1])
        if len(directions) == 0:
            group = generated(turns[:, :3, :3], same=_SAME_DECLARED)
            if group is None:
                raise SettingError(
                    f"turns are no group of at most {LARGEST_GROUP}; accepted: turns whose "
                    "products are among them, and axes for revolution"
                )
            return cls(centre, group)
        axis = directions[0]
        along = np.abs(directions @ axis)
        ends = rotated(turns[:, :3, :3], axis)  # (T, 3)
        swapped = ends[ends @ axis < 0.0]
        if (along < np.cos(_SAME_DECLARED)).any():
            return cls(centre, sphere=True)
        if (np.abs(ends @ axis) < np.cos(_SAME_DECLARED)).any():
            raise SettingError(
                "a turn moves the axis of revolution to another direction; accepted: turns about "
                "it, and those that swap its ends"
            )
        if len(swapped) == 0:
            return cls(centre, axis=axis)
        across = np.linalg.svd(axis[None])[2][1]  # unit, at a right angle to the axis
        half = 2.0 * np.outer(across, across) - np.eye(3)
        return cls(centre, np.array([np.eye(3), half]), axis=axis)

    @cached_property
    def digest(self) -> str:
        """Digest of the symmetries."""
        axis = np.zeros(3) if self.axis is None else self.axis
        return digest(self.centre, self.rotations, axis, np.array([float(self.sphere)]))

    def about(self, point: FloatArray) -> ObjectSymmetry:
        """Return the same symmetries with the centre nearest to a point (3,).

        Symmetries of revolution leave an axis where it is, and the identity all points.
        """
        if self.sphere:
            return self
        kept = self.rotations.mean(axis=0)  # projects onto what all rotations leave
        if self.axis is not None:
            kept = kept @ np.outer(self.axis, self.axis)
        return replace(self, centre=self.centre + kept @ (point - self.centre))

    def rotation_errors(self, relative: FloatArray) -> FloatArray:
        """Return the smallest angles (B,), radians, of rotations (B, 3, 3) times a symmetry.

        relative: object_from_world of an estimate times world_from_object of the truth. Over all
        rotations about an axis u, the smallest angle of R times one is the angle from u to R u.
        """
        if self.sphere:
            return np.zeros(len(relative))
        turned = product(relative[:, None], self.rotations)  # (B, S, 3, 3)
        if self.axis is None:
            return rotation_angle(turned).min(axis=1)
        moved = rotated(turned, self.axis)  # (B, S, 3)
        sine = np.sqrt((np.cross(self.axis, moved) ** 2).sum(axis=-1))
        return arctangents(sine, (self.axis * moved).sum(axis=-1)).min(axis=1)

    def nearest(self, rotations: FloatArray, to: FloatArray) -> FloatArray:
        """Return rotations (M, 3, 3) of the same look as given ones, as near to one as possible.

        rotations (M, 3, 3), to (3, 3): world_from_object.
        """
        if self.sphere:
            return np.broadcast_to(to, rotations.shape)
        alike = product(rotations[:, None], self.rotations)  # (M, S, 3, 3)
        if self.axis is not None:
            # tr(to^T R turn(t)) = a + b cos t + c sin t about the axis
            relative = product(to.T, alike)
            along = self.axis[:, None] * self.axis
            b = (relative * (np.eye(3) - along)).sum(axis=(-2, -1))
            c = (relative * hat(self.axis).T).sum(axis=(-2, -1))
            angles = arctangents(c, b)
            turns = axis_angle(np.broadcast_to(self.axis, (*angles.shape, 3)), angles)
            alike = product(alike, turns)
        best = np.argmin(rotation_angle(product(to.T, alike)), axis=1)
        return alike[np.arange(len(alike)), best]

    def nearest_copies(self, poses: Poses, to: Poses) -> Poses:
        """Return poses (B, 12) turned by the symmetries that bring each nearest to a pose (1, 12).

        The object's centre stays where it is.
        """
        back = np.swapaxes(poses.rotations, 1, 2)
        alike = self.nearest(back, np.swapaxes(to.rotations, 1, 2)[0])
        turns = np.swapaxes(alike, 1, 2)  # object_from_world
        places = rotated(back, self.centre - poses.translations)  # of the centre, world
        return Poses.of(compose(turns, self.centre - rotated(turns, places)))


def symmetry_from_settings(name: str, given: Any) -> ObjectSymmetry | None:
    """Return the symmetries of plain values: "none", or a mapping of turns and axes.

    name: of the values, in errors. None: nothing is declared. Raise SettingError for anything else.
    """
    if given is None:
        return None
    if given == "none":
        return ObjectSymmetry()
    if not isinstance(given, Mapping) or not given or not given.keys() <= {"turns", "axes"}:
        accepted = '"none", or turns (T, 4, 4) and axes (K, 2, 3), metres'
        raise SettingError(f"{name} is {quoted(given)}; accepted: {accepted}")
    try:
        return ObjectSymmetry.declared(**given)
    except (SettingError, PoseError) as error:
        raise SettingError(f"{name}: {error}") from None


def _common_centre(turns: FloatArray, directions: FloatArray, *, points: FloatArray) -> FloatArray:
    """Return the point (3,) that motions (T, 4, 4) and turns about axes (K, 3) leave.

    points (K, 3): on the axes. Raise SettingError if there is none.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None]  # (K, 3, 3)
    matrix = np.concatenate([np.eye(3) - turns[:, :3, :3], across]).reshape(-1, 3)
    right = np.concatenate([turns[:, :3, 3], rotated(across, points)]).reshape(-1)
    if len(right) == 0:
        return np.zeros(3)
    centre = np.linalg.lstsq(matrix, right, rcond=1e-6)[0]
    off = float(np.abs(matrix @ centre - right).max())
    if off > _SAME_PLACE + _SAME_SHARE * float(np.abs(right).max()):
        raise SettingError(
            f"the symmetries have no common centre, by {1e3 * off:.2g} mm; accepted: rotations "
            "about one point, in the object's frame, metres"
        )
    return np.asarray(centre)


def angles_between(turns: FloatArray, others: FloatArray) -> FloatArray:
    """Return angles (T, O), radians, between rotations (T, 3, 3) and (O, 3, 3)."""
    trace = turns.reshape(-1, 9) @ others.reshape(-1, 9).T
    return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))


def distinct_turns(turns: FloatArray, most: int, *, same: float) -> FloatArray:
    """Return rotations (T, 3, 3) without those near an earlier one, at most so many.

    same: angle between two approximations of one, radians.
    """
    kept: list[FloatArray] = []
    while len(turns) and len(kept) < most:
        kept.append(turns[0])
        turns = turns[angles_between(turns, turns[:1])[:, 0] > same]
    return np.array(kept).reshape(-1, 3, 3)


def generated(turns: FloatArray, *, same: float) -> FloatArray | None:
    """Return the group (S, 3, 3) of products of approximate rotations (T, 3, 3), identity first.

    None if it has more than 60 elements, or is not a group. Every element is replaced by the mean
    of what the table of products says it is, which converges to an exact group (Grove, Karcher and
    Ruh, 1974, "Group actions and curvature"). same: angle between two approximations of one
    element, radians.
    """
    most = LARGEST_GROUP + 1
    turns = distinct_turns(np.concatenate([np.eye(3)[None], turns]), most, same=same)
    while True:
        products = np.einsum("iab,jbc->ijac", turns, turns).reshape(-1, 3, 3)
        angles = angles_between(products, turns)
        new = products[angles.min(axis=1) > same]
        if len(new) == 0:
            break
        turns = np.concatenate([turns, distinct_turns(new, most, same=same)])
        if len(turns) > LARGEST_GROUP:
            return None
    table = angles.argmin(axis=1).reshape(len(turns), len(turns))
    if (np.sort(table, axis=1) != np.arange(len(turns))).any():
        return None
    for _ in range(_IMPROVEMENTS):
        means = np.einsum("jba,jkbc->kac", turns, turns[table])
        left, _, right = np.linalg.svd(means)
        turns = left @ right
    turns[0] = np.eye(3)  # without the rounding
    return turns
