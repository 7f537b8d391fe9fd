"""The pose of an object on the floor: turned as a configuration says, and rolled to rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, axis_angle, compose, roll_pitch_yaw
from runners.sessions.configurations import MESH_YAW, Configuration

if TYPE_CHECKING:
    import trimesh

_FLAT = 1e-6  # m: vertices lower than this touch the floor
_MOST_ROLLS = 1000


def laid_down(mesh: trimesh.Trimesh, configuration: Configuration) -> FloatArray:
    """Return the pose world_from_object (4, 4) of a configuration's object on the floor.

    The object is turned as the configuration says, sinks and rolls to rest, and is slid back until
    its centre of mass has the configuration's x and y.
    """
    resting = roll_to_rest(mesh, spawn_pose(mesh, configuration))
    slide = np.array(configuration.position) - apply(resting, centre_of_mass(mesh)[None])[0]
    resting[:2, 3] += slide[:2]
    return resting


def on_stand(world_from_object: FloatArray, configuration: Configuration) -> FloatArray:
    """Return a pose (4, 4) raised from the floor onto what the configuration's object lies on."""
    raised = world_from_object.copy()
    raised[2, 3] += configuration.stand
    return raised


def spawn_pose(mesh: trimesh.Trimesh, configuration: Configuration) -> FloatArray:
    """Return the pose world_from_object (4, 4) that a configuration states, floor or not."""
    own_yaw = axis_angle(np.eye(3)[2], MESH_YAW.get(configuration.object, 0.0))
    rotation = roll_pitch_yaw(np.array(configuration.rotation)) @ own_yaw
    return compose(rotation, np.array(configuration.position) - rotation @ centre_of_mass(mesh))


def centre_of_mass(mesh: trimesh.Trimesh) -> FloatArray:
    """Return the centre of mass (3,) in the mesh's frame; of the convex hull of an open mesh."""
    solid = mesh if mesh.is_watertight else mesh.convex_hull
    return np.asarray(solid.center_mass, dtype=np.float64)


def lowest(mesh: trimesh.Trimesh, world_from_object: FloatArray) -> float:
    """Return height in metres of the mesh's lowest point above the floor."""
    return float(apply(world_from_object, np.asarray(mesh.vertices))[:, 2].min())


def roll_to_rest(mesh: trimesh.Trimesh, world_from_object: FloatArray) -> FloatArray:
    """Return the pose (4, 4) in which a mesh rests that is put down on the floor gently.

    It sinks to the floor and, as long as its centre of mass is not above where it stands, tilts
    over the nearest point of support until its next vertex meets the floor.
    Raise SessionError if it never comes to rest.
    """
    vertices = np.asarray(mesh.convex_hull.vertices, dtype=np.float64)
    rotation = world_from_object[:3, :3]
    translation = world_from_object[:3, 3].copy()
    centre = centre_of_mass(mesh)
    for _ in range(_MOST_ROLLS):
        placed = vertices @ rotation.T + translation
        translation[2] -= placed[:, 2].min()
        placed[:, 2] -= placed[:, 2].min()
        weight = rotation @ centre + translation
        pivot = _nearest_support(placed[placed[:, 2] < _FLAT, :2], weight[:2])
        away = weight[:2] - pivot
        if np.sqrt(away @ away) < _FLAT:
            return compose(rotation, translation)
        turn = _tilt(placed, pivot, away=away)
        pivot3 = np.array([*pivot, 0.0])
        rotation = turn @ rotation
        translation = turn @ (translation - pivot3) + pivot3
    raise SessionError(f"the object does not come to rest within {_MOST_ROLLS} rolls")


def _tilt(placed: FloatArray, pivot: FloatArray, *, away: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that tilts vertices (V, 3) over a pivot to the next vertex."""
    direction = away / np.sqrt(away @ away)
    distance = (placed[:, :2] - pivot) @ direction
    height = placed[:, 2]
    free = height >= _FLAT
    angle = float(np.arctan2(height[free], distance[free]).min())
    return axis_angle(np.array([-direction[1], direction[0], 0.0]), angle)


def _nearest_support(support: FloatArray, point: FloatArray) -> FloatArray:
    """Return the point (2,) nearest to `point` of the polygon of touching vertices (S, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(support)
        corners = support[hull.vertices]
        if (hull.equations @ [*point, 1.0] <= 0.0).all():
            return point
    except (QhullError, ValueError):  # one point, or all on a line
        widest = int(np.argmax(np.ptp(support, axis=0)))
        corners = support[[np.argmin(support[:, widest]), np.argmax(support[:, widest])]]
    start = corners
    side = np.roll(corners, -1, axis=0) - corners
    length = np.maximum((side**2).sum(axis=1), 1e-30)
    along = np.clip(((point - start) * side).sum(axis=1) / length, 0.0, 1.0)
    nearest = start + along[:, None] * side
    return nearest[np.argmin(((nearest - point) ** 2).sum(axis=1))]
