"""Contacts of pads and of hands.

A soft membrane with a camera behind it touches where it is pressed in (CHSEL, Sec. V-B), a solid
body where the force and torque that act on it say.

A contact at p exerts the force f and, about the origin, the torque t = p x f: so p is on the line
of points f x t / |f|^2 + s f, the axis of the wrench (Bicchi, Salisbury and Brock, "Contact sensing
from force measurements", IJRR 1993). What a soft contact transmits of torque about its normal is
left out: it moves the line where the force is inclined to the normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from chsel.errors import PointsError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray

_SAME = 1e-3  # m: vertices that lie no further ahead than this are alike
_PARALLEL = 1e-12  # of the product of two lengths


def deformation(
    reference: FloatArray, depth: FloatArray, *, valid: BoolArray | None = None
) -> FloatArray:
    """Return how far (H, W), in metres, a membrane is pressed towards its camera.

    reference (H, W): depths of the untouched membrane. depth (H, W): depths now. 0 where either is
    missing (0, negative, not finite) or is not `valid` (H, W). Raise PointsError for shapes that
    differ.
    """
    reference, depth = np.asarray(reference, np.float64), np.asarray(depth, np.float64)
    if reference.shape != depth.shape:
        raise PointsError(
            f"the reference image has shape {reference.shape}; accepted: {depth.shape}, as the "
            "images that are compared with it"
        )
    measured = np.isfinite(reference) & np.isfinite(depth) & (reference > 0.0) & (depth > 0.0)
    if valid is not None:
        measured &= valid
    return np.subtract(reference, depth, out=np.zeros(depth.shape), where=measured)


def smooth(image: FloatArray, side: int) -> FloatArray:
    """Return the image (H, W) under a mean filter of side x side pixels; borders are reflected.

    An even side reaches one pixel further up and left than down and right. Values that are not
    finite count as 0; otherwise they would spread over their row and column.
    """
    from scipy.ndimage import uniform_filter

    require_positive("side of the filter", side)
    image = np.asarray(image, np.float64)
    return uniform_filter(np.where(np.isfinite(image), image, 0.0), size=side, mode="reflect")


def contact_mask(
    deformation: FloatArray, *, quantile: float, threshold: float, valid: BoolArray | None = None
) -> BoolArray:
    """Return pixels (H, W) in contact: deformed above a quantile of all and `threshold` m.

    valid (H, W): pixels that count; None: all.
    """
    counted = np.ones(deformation.shape, dtype=bool) if valid is None else np.asarray(valid)
    if not counted.any():
        return np.zeros(deformation.shape, dtype=bool)
    level = max(float(np.quantile(deformation[counted], quantile)), threshold)
    return counted & (deformation > level)


def contact_subset(count: int, most: int, *, stream: np.random.Generator) -> IntArray:
    """Return ascending indices of at most `most` of `count` pixels; all subsets are equally likely.

    All of them, without drawing from the stream, if there are no more than that.
    """
    if count <= most:
        return np.arange(count)
    return np.sort(np.argsort(stream.random(count), kind="stable")[:most])


def share(counts: Sequence[int], most: int) -> list[int]:
    """Return how many of at most `most` points each camera gets, in proportion to its count.

    They sum to `most`, or to all points if these are fewer. The remainders of the division go to
    the cameras with the largest fractions, to the first among equals.
    """
    total = sum(counts)
    if total <= most:
        return list(counts)
    shares = [count * most // total for count in counts]
    by_remainder = sorted(range(len(counts)), key=lambda n: -(counts[n] * most % total))
    for n in by_remainder[: most - sum(shares)]:
        shares[n] += 1
    return shares


class ForceContact(NamedTuple):
    """A contact on a body."""

    point: FloatArray  # (3,), metres
    normal: FloatArray  # (3,), unit, outward from the body, or against the force
    miss: float  # metres from the line of force


def contact_on_axis(
    force: FloatArray, torque: FloatArray, *, triangles: FloatArray
) -> ForceContact:
    """Return the point of a body's surface where the line of a force on the body enters it.

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
        return _nearest_edge(start, way, triangles=triangles, edges=edges, normals=normals)
    ahead = ((triangles[enters, 0] - start) * normals[enters]).sum(axis=1) / slope[enters]
    first = int(np.argmin(ahead))
    return ForceContact(start + ahead[first] * way, _unit(normals[enters[first]]), miss=0.0)


def contact_ahead(force: FloatArray, triangles: FloatArray) -> ForceContact:
    """Return the point of a body that is furthest against a force on it, without any torque.

    force (3,): newtons, not 0. triangles (F, 3, 3): metres. The mean of the vertices that lie
    within 1 mm of the furthest one, such as the middle of a face that meets the object squarely.
    """
    way = _unit(force)
    vertices = np.unique(triangles.reshape(-1, 3), axis=0)
    ahead = -(vertices * way).sum(axis=1)
    return ForceContact(vertices[ahead >= ahead.max() - _SAME].mean(axis=0), -way, miss=0.0)


def _nearest_edge(
    start: FloatArray,
    way: FloatArray,
    *,
    triangles: FloatArray,
    edges: FloatArray,
    normals: FloatArray,
) -> ForceContact:
    """Return the point on edges (F, 3, 3) that is nearest to a line."""
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
    return ForceContact(point, _unit(normals[face]), miss=float(np.sqrt(away[face, edge])))


def _unit(vector: FloatArray) -> FloatArray:
    length = np.sqrt((vector**2).sum())
    unit: FloatArray = vector / np.where(length > 0.0, length, 1.0)
    return unit
