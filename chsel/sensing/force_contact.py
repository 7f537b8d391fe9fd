"""Where a single contact is on a solid body, by the force and torque that act on the body.

A contact at p exerts the force f and, about the origin, the torque t = p x f: so p is on the line
of points f x t / |f|^2 + s f, the axis of the wrench (Bicchi, Salisbury and Brock, "Contact sensing
from force measurements", IJRR 1993). What a soft contact transmits of torque about its normal is
left out: it moves the line where the force is inclined to the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray

_SAME = 1e-3  # m: vertices that lie no further ahead than this are alike
_PARALLEL = 1e-12  # of the product of two lengths


@dataclass(frozen=True, eq=False)
class ForceContact:
    """A contact on a body."""

    point: FloatArray  # (3,), metres
    normal: FloatArray  # (3,), unit, outward from the body, or against the force
    miss: float  # metres from the line of force


def contact_on_axis(force: FloatArray, torque: FloatArray, triangles: FloatArray) -> ForceContact:
    """The point of a body's surface where the line of a force that acts on the body enters it.

    force (3,): newtons, not 0. torque (3,): newton metres about the origin. triangles (F, 3, 3):
    of closed bodies that may overlap, wound counter-clockwise as seen from outside, metres, in the
    frame of force and torque. Of several entries the first, which is outside of all bodies. If the
    line misses them all, the point of their edges nearest to it.
    """
    square = (force**2).sum()
    start = np.cross(force, torque) / square
    way = force / np.sqrt(square)
    edges = np.roll(triangles, -1, axis=1) - triangles  # (F, 3, 3), from each vertex to the next
    normals = np.cross(edges[:, 0], edges[:, 1])
    # Which way round the line passes each edge; the same for all three where it meets a face.
    sides = (np.cross(triangles - start, edges) * way).sum(axis=-1)  # (F, 3)
    slope = (normals * way).sum(axis=1)
    met = (sides >= 0.0).all(axis=1) | (sides <= 0.0).all(axis=1)
    enters = np.flatnonzero(met & (slope < 0.0))
    if len(enters) == 0:
        return _nearest_edge(start, way, triangles, edges, normals)
    ahead = ((triangles[enters, 0] - start) * normals[enters]).sum(axis=1) / slope[enters]
    first = int(np.argmin(ahead))
    return ForceContact(start + ahead[first] * way, _unit(normals[enters[first]]), 0.0)


def contact_ahead(force: FloatArray, triangles: FloatArray) -> ForceContact:
    """The point of a body that is furthest against a force on it, where no torque is known.

    force (3,): newtons, not 0. triangles (F, 3, 3): metres. The mean of the vertices that lie
    within 1 mm of the furthest one, such as the middle of a face that meets the object squarely.
    """
    way = _unit(force)
    vertices = np.unique(triangles.reshape(-1, 3), axis=0)
    ahead = -(vertices * way).sum(axis=1)
    return ForceContact(vertices[ahead >= ahead.max() - _SAME].mean(axis=0), -way, 0.0)


def _nearest_edge(
    start: FloatArray,
    way: FloatArray,
    triangles: FloatArray,
    edges: FloatArray,
    normals: FloatArray,
) -> ForceContact:
    """The point on edges (F, 3, 3) that is nearest to a line."""
    from_line = triangles - start
    from_line = from_line - (from_line * way).sum(axis=-1, keepdims=True) * way
    across = edges - (edges * way).sum(axis=-1, keepdims=True) * way
    length = (across**2).sum(axis=-1)
    known = length > _PARALLEL * (edges**2).sum(axis=-1)
    along = -(from_line * across).sum(axis=-1) / np.where(known, length, 1.0)
    part = np.where(known, np.clip(along, 0.0, 1.0), 0.5)
    away = ((from_line + part[..., None] * across) ** 2).sum(axis=-1)
    face, edge = np.unravel_index(int(np.argmin(away)), away.shape)
    point = triangles[face, edge] + part[face, edge] * edges[face, edge]
    return ForceContact(point, _unit(normals[face]), float(np.sqrt(away[face, edge])))


def _unit(vector: FloatArray) -> FloatArray:
    length = np.sqrt((vector**2).sum())
    unit: FloatArray = vector / np.where(length > 0.0, length, 1.0)
    return unit
