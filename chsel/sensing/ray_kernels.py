"""Marking voxels of a dense grid: those that line segments pass, and those that points lie in."""

from __future__ import annotations

from math import floor, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import moved, pose_at

_FARTHEST = 2.0**52  # voxels from the first: beyond, neighbours are the same number
_SHORTEST = 1e-100  # voxels: shorter moves along an axis count as none


class MarkedVoxels(NamedTuple):
    """Marks of V voxels. Threads may mark one grid at once: all they ever do is write ones."""

    marks: NDArray[np.uint8]  # (V,) in C order, 1 for a marked voxel
    counts: tuple[int, int, int]  # voxels per axis
    lower: FloatArray  # (3,): centre of the first voxel, metres
    spacing: float  # of the centres, metres


class RayImage(NamedTuple):
    """Depths of a camera, and which of its rays count."""

    depth: FloatArray  # (H, W), metres along z
    mask: BoolArray  # (H, W)
    columns: FloatArray  # (W,): x / z of the pixels
    rows: FloatArray  # (H,): y / z of the pixels


@compiled
def mark_segments(grid, origins, ends, first, last):
    """Mark the voxels on segments first to last, from origins (1 or N, 3) to ends (N, 3)."""
    for n in range(first, last):
        o = n if len(origins) > 1 else 0
        a = _place(grid, origins[o, 0], origins[o, 1], origins[o, 2])
        b = _place(grid, ends[n, 0], ends[n, 1], ends[n, 2])
        _walk(grid, a, b)


@compiled
def mark_image(grid, image, pose, fraction, first, last):
    """Mark the voxels on the rays of the masked pixels of rows first to last of a RayImage.

    pose: of the camera, world_from_camera. Rays end at `fraction` of their depth.
    """
    a = _place(grid, pose[9], pose[10], pose[11])
    for row in range(first, last):
        for column in range(len(image.columns)):
            if image.mask[row, column]:
                z = fraction * image.depth[row, column]
                x, y, z = moved(pose, image.columns[column] * z, image.rows[row] * z, z)
                _walk(grid, a, _place(grid, x, y, z))


@compiled
def mark_points(grid, points, moves, first, last):
    """Mark the voxels of points (N, 3) first to last, moved by each of the moves (P, 12)."""
    nx, ny, nz = grid.counts
    lower, spacing = grid.lower, grid.spacing
    for n in range(first, last):
        for p in range(len(moves)):
            x, y, z = moved(pose_at(moves, p), points[n, 0], points[n, 1], points[n, 2])
            i = np.rint((x - lower[0]) / spacing)
            j = np.rint((y - lower[1]) / spacing)
            k = np.rint((z - lower[2]) / spacing)
            if 0.0 <= i < nx and 0.0 <= j < ny and 0.0 <= k < nz:
                grid.marks[(int(i) * ny + int(j)) * nz + int(k)] = 1


@compiled
def settle(words, marks, seen, gain, enough):
    """Add `gain` to the views `seen` (V,) of marked voxels, up to `enough`, and unmark them.

    words: the bytes of `marks` (V,) by eights, as most voxels are not marked. Returns the number of
    voxels that reached `enough`. Voxels with more than enough views stay as they are.
    """
    fresh = 0
    for word in range(len(words)):
        if words[word]:
            for n in range(8 * word, min(8 * word + 8, len(marks))):
                if marks[n]:
                    marks[n] = 0
                    if seen[n] < enough:
                        seen[n] = min(seen[n] + gain, enough)
                        fresh += 1 if seen[n] == enough else 0
    return fresh


@leaf
def _place(grid, x, y, z):
    """A point in units of voxels: voxel k is from k to k + 1."""
    lower, spacing = grid.lower, grid.spacing
    return (
        (x - lower[0]) / spacing + 0.5,
        (y - lower[1]) / spacing + 0.5,
        (z - lower[2]) / spacing + 0.5,
    )


@inner
def _walk(grid, a, b):
    """Mark the voxels from place a to place b, one after the other (Amanatides and Woo, 1987).

    The voxels of both ends are computed first, so the number of faces crossed along each axis is
    known, and rounding cannot lead out of the grid or past the end. Crossings are not summed up but
    computed from their faces. Two crossings at once lead over an edge, to the voxel across it.
    """
    if not (_near(a) and _near(b)):  # nor for NaN
        return
    ax, ay, az = a
    dx, dy, dz = b[0] - ax, b[1] - ay, b[2] - az
    nx, ny, nz = grid.counts
    enters, leaves = _clipped(ax, dx, nx, 0.0, 1.0)
    enters, leaves = _clipped(ay, dy, ny, enters, leaves)
    enters, leaves = _clipped(az, dz, nz, enters, leaves)
    if enters >= leaves:
        return
    i, far_i = _voxel(ax, dx, enters, nx), _voxel(ax, dx, leaves, nx)
    j, far_j = _voxel(ay, dy, enters, ny), _voxel(ay, dy, leaves, ny)
    k, far_k = _voxel(az, dz, enters, nz), _voxel(az, dz, leaves, nz)
    if leaves == 1.0:  # the end itself, without rounding
        far_i, far_j, far_k = _within(b[0], nx), _within(b[1], ny), _within(b[2], nz)
    step_i, face_i, left_i, inverse_x = _crossings(i, far_i, dx)
    step_j, face_j, left_j, inverse_y = _crossings(j, far_j, dy)
    step_k, face_k, left_k, inverse_z = _crossings(k, far_k, dz)
    at_x = (face_i - ax) * inverse_x if left_i > 0 else inf
    at_y = (face_j - ay) * inverse_y if left_j > 0 else inf
    at_z = (face_k - az) * inverse_z if left_k > 0 else inf
    voxel, last = (i * ny + j) * nz + k, (far_i * ny + far_j) * nz + far_k
    stride_i, stride_j = step_i * ny * nz, step_j * nz
    _mark(grid.marks, voxel)
    while voxel != last:
        at = min(at_x, at_y, at_z)
        if at_x == at:
            voxel += stride_i
            left_i -= 1
            face_i += step_i
            at_x = (face_i - ax) * inverse_x if left_i > 0 else inf
        if at_y == at:
            voxel += stride_j
            left_j -= 1
            face_j += step_j
            at_y = (face_j - ay) * inverse_y if left_j > 0 else inf
        if at_z == at:
            voxel += step_k
            left_k -= 1
            face_k += step_k
            at_z = (face_k - az) * inverse_z if left_k > 0 else inf
        _mark(grid.marks, voxel)


@leaf
def _mark(marks, voxel):
    if marks[voxel] == 0:  # most are marked already, and concurrent writes are slow
        marks[voxel] = 1


@leaf
def _near(place):
    x, y, z = place
    return abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST


@leaf
def _clipped(a, d, count, enters, leaves):
    """The part of a + t d that is within one axis of the grid; empty if enters >= leaves."""
    if abs(d) < _SHORTEST:
        return (enters, leaves) if 0.0 <= a < count else (1.0, 0.0)
    low, high = -a / d, (count - a) / d
    return max(enters, min(low, high)), min(leaves, max(low, high))


@leaf
def _voxel(a, d, at, count):
    return _within(a + at * d, count)


@leaf
def _within(place, count):
    """The voxel of a place; rounding may have left it just outside."""
    return min(max(floor(place), 0), count - 1)


@leaf
def _crossings(voxel, last, d):
    """Step along an axis, first face to cross, number of faces to cross, and 1 / d."""
    step = 1 if last > voxel else -1
    face = float(voxel + 1 if last > voxel else voxel)
    inverse = 1.0 / d if abs(d) >= _SHORTEST else 0.0
    return step, face, abs(last - voxel), inverse
