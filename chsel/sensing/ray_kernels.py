"""Marks voxels of a dense grid: those that line segments pass, and those that points lie in.

A grid is the bytes `met` of its voxels in C order, its voxels per axis `counts`, the centre of the
first voxel `lower` and the `spacing` of the centres in metres. Threads may mark the same grid at
once, as all they ever do is to set a byte to 1.
"""

from __future__ import annotations

from math import floor, inf

import numpy as np

from chsel.numerics.compiler import compiled, inner, leaf


@compiled
def window_minimum(image, size):
    """Replace each pixel of image (H, W) by the least of the size x size right of and below it.

    Those of the last size - 1 rows and columns, whose windows are not whole, are of no use. Windows
    grow to twice their side each time, until they have the size.
    """
    rows, columns = image.shape
    side = 1
    while side < size:
        step = min(side, size - side)
        for row in range(rows - step):
            line, below = image[row], image[row + step]
            for column in range(columns):
                line[column] = min(line[column], below[column])
        for row in range(rows):
            line = image[row]
            for column in range(columns - step):
                line[column] = min(line[column], line[column + step])
        side += step


_FARTHEST = 2.0**52  # voxels from the first: beyond, neighbours are the same number
_SHORTEST = 1e-100  # voxels: a shorter way along an axis is none


@compiled
def mark_segments(met, counts, lower, spacing, origins, ends, first, last):
    """Mark what the segments first to last from origins (1 or N, 3) to ends (N, 3) pass."""
    for n in range(first, last):
        o = n if len(origins) > 1 else 0
        a = _place(lower, spacing, origins[o, 0], origins[o, 1], origins[o, 2])
        b = _place(lower, spacing, ends[n, 0], ends[n, 1], ends[n, 2])
        _walk(met, counts, a, b)


@compiled
def mark_image(met, counts, lower, spacing, image, move, fraction, first, last):
    """Mark what the rays of the masked pixels of rows first to last pass.

    image: depth (H, W), mask (H, W), and x / z (W,) and y / z (H,) of the pixels. move (3, 4): from
    the camera's frame. Rays end at `fraction` of their depth.
    """
    depth, mask, columns, rows = image
    a = _place(lower, spacing, move[0, 3], move[1, 3], move[2, 3])
    for row in range(first, last):
        for column in range(len(columns)):
            if mask[row, column]:
                z = fraction * depth[row, column]
                x, y, z = _moved(move, columns[column] * z, rows[row] * z, z)
                _walk(met, counts, a, _place(lower, spacing, x, y, z))


@compiled
def mark_points(met, counts, lower, spacing, points, moves, first, last):
    """Mark where points (N, 3) first to last come to lie by each of the moves (P, 3, 4)."""
    nx, ny, nz = counts
    for n in range(first, last):
        for p in range(len(moves)):
            x, y, z = _moved(moves[p], points[n, 0], points[n, 1], points[n, 2])
            i = np.rint((x - lower[0]) / spacing)
            j = np.rint((y - lower[1]) / spacing)
            k = np.rint((z - lower[2]) / spacing)
            if 0.0 <= i < nx and 0.0 <= j < ny and 0.0 <= k < nz:
                met[(int(i) * ny + int(j)) * nz + int(k)] = 1


@compiled
def settle(words, met, seen, gain, enough):
    """Add `gain` to how often (V,) marked voxels were seen, up to `enough`, and unmark all.

    words: the bytes of `met` by eights, the last ones filled up, as most voxels are not marked. How
    many of them now have enough. Those with more than enough stay as they are.
    """
    fresh = 0
    for word in range(len(words)):
        if words[word]:
            for n in range(8 * word, min(8 * word + 8, len(met))):
                if met[n]:
                    met[n] = 0
                    if seen[n] < enough:
                        seen[n] = min(seen[n] + gain, enough)
                        fresh += 1 if seen[n] == enough else 0
    return fresh


@leaf
def _moved(move, x, y, z):
    return (
        move[0, 0] * x + move[0, 1] * y + move[0, 2] * z + move[0, 3],
        move[1, 0] * x + move[1, 1] * y + move[1, 2] * z + move[1, 3],
        move[2, 0] * x + move[2, 1] * y + move[2, 2] * z + move[2, 3],
    )


@leaf
def _place(lower, spacing, x, y, z):
    """Where a point is, in voxels: voxel k is from k to k + 1."""
    return (
        (x - lower[0]) / spacing + 0.5,
        (y - lower[1]) / spacing + 0.5,
        (z - lower[2]) / spacing + 0.5,
    )


@inner
def _walk(met, counts, a, b):
    """Mark the voxels from place a to place b, one after the other (Amanatides and Woo).

    The voxels of both ends are found first, so that along each axis it is known how many faces are
    crossed, and no rounding leads out of the grid or past the end. Crossings are not summed up but
    follow from their faces. Two at once lead over an edge, to a voxel across it.
    """
    if not (_near(a) and _near(b)):  # nor is what is no number
        return
    ax, ay, az = a
    dx, dy, dz = b[0] - ax, b[1] - ay, b[2] - az
    nx, ny, nz = counts
    enters, leaves = _clipped(ax, dx, nx, 0.0, 1.0)
    enters, leaves = _clipped(ay, dy, ny, enters, leaves)
    enters, leaves = _clipped(az, dz, nz, enters, leaves)
    if enters >= leaves:
        return
    i, far_i = _voxel(ax, dx, enters, nx), _voxel(ax, dx, leaves, nx)
    j, far_j = _voxel(ay, dy, enters, ny), _voxel(ay, dy, leaves, ny)
    k, far_k = _voxel(az, dz, enters, nz), _voxel(az, dz, leaves, nz)
    if leaves == 1.0:  # as exactly as the end was given
        far_i, far_j, far_k = _within(b[0], nx), _within(b[1], ny), _within(b[2], nz)
    step_i, face_i, left_i, inverse_x = _way(i, far_i, dx)
    step_j, face_j, left_j, inverse_y = _way(j, far_j, dy)
    step_k, face_k, left_k, inverse_z = _way(k, far_k, dz)
    at_x = (face_i - ax) * inverse_x if left_i > 0 else inf
    at_y = (face_j - ay) * inverse_y if left_j > 0 else inf
    at_z = (face_k - az) * inverse_z if left_k > 0 else inf
    voxel, last = (i * ny + j) * nz + k, (far_i * ny + far_j) * nz + far_k
    stride_i, stride_j = step_i * ny * nz, step_j * nz
    _mark(met, voxel)
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
        _mark(met, voxel)


@leaf
def _mark(met, voxel):
    if met[voxel] == 0:  # most are marked already, and threads wait for each other's writes
        met[voxel] = 1


@leaf
def _near(place):
    x, y, z = place
    return abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST


@leaf
def _clipped(a, d, count, enters, leaves):
    """The part of a way a + t d that is within one axis of the grid; none if it enters last."""
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
def _way(voxel, last, d):
    """Step along an axis, its first face, how many there are, and 1 / d."""
    step = 1 if last > voxel else -1
    face = float(voxel + 1 if last > voxel else voxel)
    inverse = 1.0 / d if abs(d) >= _SHORTEST else 0.0
    return step, face, abs(last - voxel), inverse
