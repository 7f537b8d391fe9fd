"""The rotations that map an object onto itself: poses that differ by one look the same."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.elementary import arctangents
from chsel.plausible.symmetry_search import (
    RotatedSurface,
    axes_of_revolution,
    finite_group,
    half_turn_across,
)
from chsel.problem.mesh import mesh_digest
from chsel.problem.poses import product, rotated, rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.surface import has_surface, object_centre

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class ObjectSymmetry:
    """The symmetries of an object: proper rotations about its centre, in the object's frame.

    They are `rotations` if there is no axis of revolution, their products with the rotations by all
    angles about the axis if there is one, and all rotations for a sphere. By default the identity
    alone, about the origin of the object's frame.
    """

    centre: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,), m
    rotations: FloatArray = field(default_factory=lambda: np.eye(3)[None])  # (S, 3, 3)
    axis: FloatArray | None = None  # (3,), unit, of revolution
    sphere: bool = False

    def rotation_errors(self, relative: FloatArray) -> FloatArray:
        """The smallest angles (B,), radians, of rotations (B, 3, 3) times a symmetry.

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


def object_symmetry(mesh: trimesh.Trimesh) -> ObjectSymmetry:
    """The symmetries of a mesh, within the tolerance of `RotatedSurface`.

    The centre is the surface's centroid, which every symmetry maps to itself, and which open meshes
    have, too. A pure function of vertices and faces; the last few results are kept.
    """
    return _symmetry(_MeshByDigest(mesh_digest(mesh), mesh))


def grid_symmetry(sdf: SdfGrid) -> ObjectSymmetry:
    """The identity alone, about the centre of an object whose mesh is not available."""
    return ObjectSymmetry(object_centre(sdf) if has_surface(sdf) else sdf.bounds.mean(axis=0))


@dataclass(frozen=True)
class _MeshByDigest:
    """A mesh, equal to all of the same content."""

    digest: str
    mesh: trimesh.Trimesh = field(compare=False)


@lru_cache(maxsize=8)
def _symmetry(key: _MeshByDigest) -> ObjectSymmetry:
    surface = RotatedSurface(key.mesh)
    if surface.radius == 0.0:
        return ObjectSymmetry(surface.centre)
    axes = axes_of_revolution(surface)
    if len(axes) > 1:
        return ObjectSymmetry(surface.centre, sphere=True)
    if len(axes) == 1:
        return ObjectSymmetry(surface.centre, half_turn_across(surface, axes[0]), axes[0])
    return ObjectSymmetry(surface.centre, finite_group(surface))
