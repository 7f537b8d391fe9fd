"""An object as a physics engine settles it on the floor: a convex body of its mass and inertia."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, compose, inverse
from runners.sessions.placement import centre_of_mass, lowest

if TYPE_CHECKING:
    import trimesh

GRAVITY = -10.0  # m/s^2
FLOOR_FRICTION = 0.6
FLOOR_SPINNING_FRICTION = 0.8
SETTLING_STEPS = 1000
OBJECT_MASS = 2.0  # kg, while it settles
LETTING_GO = 0.001  # m: how far above the floor the object is let go


@dataclass(frozen=True, eq=False)
class SettlingBody:
    """The convex hull of a mesh, in the frame of its principal axes of inertia."""

    vertices: FloatArray
    """Vertices (V, 3) of the hull, metres."""

    inertia: FloatArray
    """Principal moments of inertia (3,) of the mesh itself, kg m^2."""

    object_from_inertial: FloatArray
    """Pose (4, 4) of the body's frame in that of the mesh."""

    world_from_inertial: FloatArray
    """Pose (4, 4) at which the body is let go."""


def settling_body(mesh: trimesh.Trimesh, laid: FloatArray) -> SettlingBody:
    """Return the body of a mesh that is let go LETTING_GO above its pose (4, 4) on the floor.

    On a plane only the convex hull can touch; mass and inertia are those of the mesh itself.
    """
    solid = mesh if mesh.is_watertight else mesh.convex_hull
    inertia, axes = np.linalg.eigh(solid.moment_inertia * (OBJECT_MASS / solid.mass))
    axes[:, 2] *= np.linalg.det(axes)
    object_from_inertial = compose(axes, centre_of_mass(mesh))
    pose = laid @ object_from_inertial
    pose[2, 3] += LETTING_GO
    vertices = apply(inverse(object_from_inertial), np.asarray(mesh.convex_hull.vertices))
    return SettlingBody(
        vertices,
        inertia=inertia,
        object_from_inertial=object_from_inertial,
        world_from_inertial=pose,
    )


def settled_mesh(
    mesh: trimesh.Trimesh, body: SettlingBody, *, world_from_inertial: FloatArray
) -> FloatArray:
    """Return the pose (4, 4) of a mesh whose body has come to rest at a pose (4, 4)."""
    settled = world_from_inertial @ inverse(body.object_from_inertial)
    settled[2, 3] -= lowest(mesh, settled)  # engines let bodies hover by a margin, or sink
    return settled
