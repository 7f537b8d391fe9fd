"""How far poses of an object are from each other, but for its symmetries.

Those that are declared count as they are; else two poses look alike where the surfaces are at one
place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chsel.errors import require_instance
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.poses import Poses, compose, product, rotated, rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.surface import (
    in_order,
    outline_distances,
    outline_distances_to,
    outline_in_object,
    signed_distances,
)

TURN = 0.5  # radians: poses turned by more are different modes, unless by a symmetry
SYMMETRIC = 0.0085  # root mean square of what a symmetry moves the surface by, in diameters


def with_symmetry(sdf: SdfGrid, symmetry: ObjectSymmetry | None) -> SdfGrid:
    """Return a grid whose object has the symmetries that are declared; None: those of its surface.

    Their centre becomes that point of those which they leave that is nearest to the object's.
    """
    if symmetry is None:
        return sdf
    accepted = "chsel.ObjectSymmetry.declared(turns=, axes=), or chsel.ObjectSymmetry() for none"
    require_instance("symmetry", symmetry, kind=ObjectSymmetry, accepted=accepted)
    return replace(sdf, symmetry=symmetry.about(middle(sdf)))


def distances_apart(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Return distances (B, B), metres, of the object in poses from each other.

    As `outline_distances`, but those of the nearest copies by declared symmetries.
    """
    apart = outline_distances(sdf, poses)
    if sdf.symmetry is None:
        return apart
    for n in range(len(poses)):
        own = poses[n : n + 1]
        copies = sdf.symmetry.nearest_copies(poses, own)
        apart[n] = np.minimum(apart[n], outline_distances_to(sdf, copies, other=own))
    return np.minimum(apart, apart.T)


def distances_apart_from(sdf: SdfGrid, poses: Poses, *, other: Poses) -> FloatArray:
    """Return distances (B,), metres, of the object in each pose from that in another.

    As in `distances_apart`. other: a single pose.
    """
    apart = outline_distances_to(sdf, poses, other=other)
    if sdf.symmetry is None:
        return apart
    copies = sdf.symmetry.nearest_copies(poses, other)
    return np.minimum(apart, outline_distances_to(sdf, copies, other=other))


def turned(sdf: SdfGrid, poses: Poses, *, pairs: BoolArray, more_than: float = TURN) -> BoolArray:
    """Return flags (B, B) of those pairs of poses that differ by a rotation that is no symmetry.

    Such a rotation is larger than an angle, radians. Where symmetries are declared, it is so after
    each of them; else about the object's middle it moves the surface by more than SYMMETRIC of the
    diameter, root mean square.
    """
    one, other = np.nonzero(np.triu(pairs & (angles_apart(poses) > more_than), 1))
    result = np.zeros_like(pairs)
    turns = product(poses.rotations[one], np.swapaxes(poses.rotations[other], 1, 2))
    if sdf.symmetry is not None:
        moved = sdf.symmetry.rotation_errors(turns) > more_than
    else:
        outline, centre = outline_in_object(sdf), middle(sdf)
        about = Poses.of(compose(turns, centre - rotated(turns, centre)))
        squares = in_order(signed_distances(sdf, about, points=outline) ** 2)
        moved = np.sqrt(squares / max(len(outline), 1)) > SYMMETRIC * sdf.diameter
    result[one[moved], other[moved]] = True
    return result | result.T


def middle(sdf: SdfGrid) -> FloatArray:
    """Return centroid (3,) of the object's volume, which every symmetry leaves where it is."""
    return sdf.derived("middle", lambda: _middle(sdf))


def _middle(sdf: SdfGrid) -> FloatArray:
    share = np.clip(0.5 - sdf.values / sdf.resolution, 0.0, 1.0)  # of the cell around each node
    inside = np.argwhere(share > 0.0)
    if len(inside) == 0:
        return np.asarray(sdf.bounds.mean(axis=0))
    weights = share[tuple(inside.T)]
    return sdf.origin + sdf.resolution * in_order(weights * inside.T) / in_order(weights)


def angles_apart(poses: Poses) -> FloatArray:
    """Return the angles (B, B), radians, between poses."""
    return rotation_angle(product(poses.rotations[:, None], np.swapaxes(poses.rotations, 1, 2)))
