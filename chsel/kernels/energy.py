"""The energy of a pose: its relaxed cost, given up once it is above a limit.

Known points come first, as they are the fewest and tell the most.
"""

from __future__ import annotations

import numpy as np

from chsel.kernels.compiler import compiled, inner, leaf
from chsel.kernels.cost import Model
from chsel.kernels.field import continued, interpolated
from chsel.kernels.pose import pose_at
from chsel.kernels.region import locate
from chsel.kernels.tree import Found, found_for, walk


def found_around(model: Model) -> Found:
    """Scratch of one thread for the points of a model."""
    return found_for(max(model.free.tree.spheres.shape[1], 1))


@inner
def known_below(model, pose, limit):  # type: ignore[no-untyped-def]
    """What known and occupied points cost; infinite if it is above the limit."""
    total = 0.0
    known, field = model.known, model.field
    for n in range(known.shape[1]):
        s = distance_at(field, pose, known[0, n], known[1, n], known[2, n])
        total += model.known_scale * max(abs(s - model.known_sdf[n]) - model.known_tolerance, 0.0)
        if not total <= limit:
            return np.inf
    occupied = model.occupied
    for n in range(occupied.shape[1]):
        s = distance_at(field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        total += model.occupied_scale * max(model.alpha + s, 0.0)
        if not total <= limit:
            return np.inf
    return total


@inner
def with_free(model, pose, total, limit, found, count):  # type: ignore[no-untyped-def]
    """A sum with what the first `count` of the points found cost; infinite if above the limit."""
    free, box, table = model.free, model.field.box, model.field.table
    across, along = int(box.across), int(box.along)
    clearance, places = free.region.clearance, found.places
    locate(pose, free.region.box, found.x, found.y, found.z, places, count)
    for n in range(count):
        at = places.cell[n]
        if clearance[at] < 0.0 and places.beyond[n] == 0.0:
            s = _value(table, at, across, along, places.u[n], places.v[n], places.w[n])
            total += model.free_scale * max(model.alpha - s, 0.0)
            if not total <= limit:
                return np.inf
    return total


@inner
def energy_below(model, pose, limit, found):  # type: ignore[no-untyped-def]
    """The energy of a pose, a rigid one; infinite if it is above the limit."""
    total = known_below(model, pose, limit)
    if not total <= limit:
        return np.inf
    count = walk(model.free.tree, model.free.region, pose, 0.0, found)
    return with_free(model, pose, total, limit, found, count)


@leaf
def distance_at(field, pose, x, y, z):  # type: ignore[no-untyped-def]
    """Signed distance at a world point, interpolated."""
    return distance_with_gradient(field, pose, x, y, z)[0]


@leaf
def distance_with_gradient(field, pose, x, y, z):  # type: ignore[no-untyped-def]
    """Signed distance and its gradient (s, n_x, n_y, n_z) at a world point, interpolated."""
    box, table = field.box, field.table
    first, last, most, inverse = box.first, box.last, box.most, box.inverse
    a = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
    b = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
    c = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
    d = min(max(first[0], a), last[0])
    e = min(max(first[1], b), last[1])
    f = min(max(first[2], c), last[2])
    u, v, w = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
    i = min(np.floor(u), most[0])
    j = min(np.floor(v), most[1])
    k = min(np.floor(w), most[2])
    u, v, w = u - i, v - j, w - k
    across, along = int(box.across), int(box.along)
    at = int(i) * across + int(j) * along + int(k)
    s = _value(table, at, across, along, u, v, w)
    _, nx, ny, nz = interpolated(box, table, at, u, v, w)
    if a != d or b != e or c != f:
        s, nx, ny, nz = continued(field.box_distance, box, (s, nx, ny, nz), a, b, c)
    return s, nx, ny, nz


@leaf
def _value(table, at, across, along, u, v, w):  # type: ignore[no-untyped-def]
    """Signed distance in the cell `at`, at u, v, w of its sides."""
    low, high = 1.0 - w, w
    a = low * table[at, 0] + high * table[at + 1, 0]
    b = low * table[at + along, 0] + high * table[at + along + 1, 0]
    at += across
    c = low * table[at, 0] + high * table[at + 1, 0]
    d = low * table[at + along, 0] + high * table[at + along + 1, 0]
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * d)


@compiled
def energies_below(model, poses, limit, out, first, last, found):  # type: ignore[no-untyped-def]
    """Fill out (B,) with the energies of poses (B, 12) up to a limit, from `first` to `last`."""
    for n in range(first, last):
        out[n] = energy_below(model, pose_at(poses, n), limit, found)
