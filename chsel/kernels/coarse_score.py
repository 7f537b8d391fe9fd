"""How well a pose fits, roughly and in a fraction of a microsecond: to choose among many."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.arrays import FloatArray
from chsel.kernels.compiler import inner
from chsel.kernels.region import Box


class Coarse(NamedTuple):
    """What poses are scored by.

    box, values (nodes,): the signed distance grid, read at the nearest node. contacts (3, A),
    known_sdf (A,): some of the known points; scale: what a metre off costs. inside (3, P): points
    inside of the object; weights (P,): what each costs in free space. voxels, flags (voxels,):
    free space.
    """

    box: Box
    values: Any
    contacts: FloatArray
    known_sdf: FloatArray
    scale: float
    inside: FloatArray
    weights: FloatArray
    voxels: Box
    flags: Any


@inner
def score_below(coarse, pose, limit):  # type: ignore[no-untyped-def]
    """The score of a pose, less for a better fit; infinite if it is above the limit."""
    a, b, c, d, e, f, g, h, i, x, y, z = pose
    box, values, contacts, known_sdf = coarse.box, coarse.values, coarse.contacts, coarse.known_sdf
    first, most, inverse = box.first, box.most, box.inverse
    across, along = box.across, box.along
    x0, y0, z0 = (x - first[0]) * inverse, (y - first[1]) * inverse, (z - first[2]) * inverse
    total = 0.0
    for n in range(contacts.shape[1]):
        p, q, r = contacts[0, n] * inverse, contacts[1, n] * inverse, contacts[2, n] * inverse
        u = a * p + b * q + c * r + x0
        v = d * p + e * q + f * r + y0
        w = g * p + h * q + i * r + z0
        k, m, o = min(max(0.0, u), most[0]), min(max(0.0, v), most[1]), min(max(0.0, w), most[2])
        away = (abs(u - k) + abs(v - m) + abs(w - o)) / inverse
        s = values[int(np.rint(k) * across + np.rint(m) * along + np.rint(o))]
        total += coarse.scale * abs(s + away - known_sdf[n])
        if not total <= limit:
            return np.inf
    inside, weights, voxels, flags = coarse.inside, coarse.weights, coarse.voxels, coarse.flags
    first, most, inverse = voxels.first, voxels.most, voxels.inverse
    across, along = voxels.across, voxels.along
    for n in range(inside.shape[1]):
        u, v, w = inside[0, n] - x, inside[1, n] - y, inside[2, n] - z
        k = (a * u + d * v + g * w - first[0]) * inverse
        m = (b * u + e * v + h * w - first[1]) * inverse
        o = (c * u + f * v + i * w - first[2]) * inverse
        k, m, o = min(max(0.0, k), most[0]), min(max(0.0, m), most[1]), min(max(0.0, o), most[2])
        if flags[int(np.rint(k) * across + np.rint(m) * along + np.rint(o))]:
            total += weights[n]
            if not total <= limit:
                return np.inf
    return total
