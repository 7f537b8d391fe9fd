"""The surface of an object in several poses: how far these are apart, whatever symmetry it has."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import evenly_spaced, surface_distances
from chsel.problem.surface import has_surface, surface_points

_POINTS = 100


def outline_distances(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """How far the object's surface in a pose is from that in another (B, B), metres.

    Root mean square over points of both surfaces: 0 between poses that a symmetry maps to each
    other. As exact as the grid's interpolation, a fraction of its resolution.
    """
    places = outline_in_world(sdf, poses)[:, ::2]  # (B, Q, 3): both surfaces have as many
    squares = np.array([in_order(signed_distances(sdf, poses, there) ** 2) for there in places])
    squares /= max(places.shape[1], 1)
    apart: FloatArray = np.sqrt(0.5 * (squares + squares.T))
    np.fill_diagonal(apart, 0.0)
    return apart


def surface_spread(distances: FloatArray, weights: FloatArray | None = None) -> float:
    """Root mean square distance of the surfaces in two poses drawn from a set, metres.

    This is the spread of hypotheses and of beliefs. distances (B, B), metres: `outline_distances`.
    weights (B,): with which poses are drawn, each again; None: all alike.
    """
    if weights is None:
        weights = np.full(len(distances), 1.0 / len(distances))
    return float(np.sqrt(in_order(weights * in_order(weights * distances**2))))


def outline_distances_to(sdf: SdfGrid, poses: Poses, other: Poses) -> FloatArray:
    """How far the object's surface in each pose is from that in one other pose (B,), metres.

    As in `outline_distances`. other: a single pose.
    """
    there = outline_in_world(sdf, poses)  # (B, Q, 3)
    count, size = there.shape[:2]
    forth = signed_distances(sdf, other, there.reshape(-1, 3)).reshape(count, size)
    back = signed_distances(sdf, poses, outline_in_world(sdf, other)[0])  # (B, Q)
    squares = in_order(forth**2) + in_order(back**2)
    return np.sqrt(squares / (2 * max(size, 1)))


def outline_in_world(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Points (B, Q, 3) on the object's surface in each pose; Q is 0 for a grid without surface."""
    turns = np.swapaxes(poses.rotations, 1, 2)
    return rotated(turns[:, None], outline_in_object(sdf) - poses.translations[:, None])


def outline_in_object(sdf: SdfGrid) -> FloatArray:
    """Points (Q, 3) on the object's surface, object frame."""
    return sdf.derived("outline", lambda: _outline(sdf))


def signed_distances(sdf: SdfGrid, poses: Poses, points: FloatArray) -> FloatArray:
    """Signed distances (B, N), metres, of world points (N, 3), at most FARTHEST."""
    return np.minimum(surface_distances(sdf, poses, points), FARTHEST)


def in_order(values: FloatArray) -> FloatArray:
    """Sums along the last axis, added in their order, so that they are the same everywhere."""
    if values.shape[-1] == 0:
        return np.zeros(values.shape[:-1])
    return np.cumsum(values, axis=-1)[..., -1]


def _outline(sdf: SdfGrid) -> FloatArray:
    """Points (Q, 3) on the object's surface, object frame; none if the grid has no surface."""
    if has_surface(sdf):
        return surface_points(sdf, _POINTS, StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))
    near = np.argwhere(np.abs(sdf.values) < 2.0 * sdf.resolution)  # of objects thinner than that
    near = near[evenly_spaced(len(near), _POINTS)]
    i, j, k = near.T
    away = sdf.values[i, j, k][:, None] * sdf.gradients[i, j, k]
    points: FloatArray = sdf.origin + near * sdf.resolution - away
    return points
