"""Which points of an object's surface can be put onto which contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.far_apart import far_apart
from chsel.kernels.anchors import Anchors
from chsel.points import KnownPoints, Workspace
from chsel.sdf import SdfGrid
from chsel.space import SE2Space, SearchSpace
from chsel.streams import Purpose, StreamKey
from chsel.surface import surface_points

SURFACE_POINTS = 400
MOST_ANCHORS = 48
_LENGTHS_ALIKE = 0.004  # metres
_LEAST_LENGTH = 0.01  # metres between two contacts that tell a direction


@dataclass(frozen=True)
class AnchorSettings:
    """How poses are drawn.

    pairs: the share that puts two surface points onto the line of two contacts. contacts: the share
    that puts one onto one. The rest is uniform in the workspace and SO(3). margin: metres by which
    the workspace is widened for the object's origin.
    """

    pairs: float = 0.5
    contacts: float = 0.4
    margin: float = 0.15


def anchors_of(
    sdf: SdfGrid,
    points: KnownPoints,
    workspace: Workspace,
    space: SearchSpace,
    settings: AnchorSettings,
) -> Anchors:
    """The anchors of a problem."""
    surface, normals, lengths, by_distance = sdf.derived("anchors", lambda: _pairs_of(sdf))
    chosen = far_apart(points.known, MOST_ANCHORS)
    contacts, values = points.known[chosen], points.sdf[chosen]
    allowed = np.arange(len(surface))
    pairs = np.zeros((0, 4), dtype=np.int64)
    if isinstance(space, SE2Space):
        allowed, singles = _at_heights(space, surface, normals, contacts, values)
    else:
        whole = np.full(len(contacts), len(surface))
        singles = np.stack([np.arange(len(contacts)), 0 * whole, whole], axis=1)
        pairs = _matching(contacts, values, lengths)
    bounds = workspace.bounds + settings.margin * np.array([[-1.0], [1.0]])
    paired = settings.pairs if len(pairs) else 0.0
    return Anchors(
        contacts.T.copy(),
        values,
        surface.T.copy(),
        normals.T.copy(),
        by_distance,
        pairs,
        singles.astype(np.int64),
        allowed,
        np.array([paired, settings.pairs + settings.contacts]),
        bounds[0],
        bounds[1],
    )


def _pairs_of(sdf: SdfGrid) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Surface points and normals (Q, 3), and pairs (P, 2) of them in the order of lengths (P,)."""
    stream = StreamKey(0, 0).stream(Purpose.ANCHORS)
    surface = surface_points(sdf, SURFACE_POINTS, stream)
    normals = sdf.query(surface, lookup="trilinear")[1].numpy()
    normals = normals / np.maximum(np.sqrt((normals**2).sum(axis=1, keepdims=True)), 1e-12)
    i, j = np.triu_indices(len(surface), 1)
    lengths = np.sqrt(((surface[i] - surface[j]) ** 2).sum(axis=1))
    order = np.argsort(lengths, kind="stable")
    return surface, normals, lengths[order], np.stack([i, j], axis=1)[order]


def _matching(contacts: FloatArray, values: FloatArray, lengths: FloatArray) -> IntArray:
    """Pairs of contacts with the range of surface pairs of their length (C, 4)."""
    touching = np.flatnonzero(values == 0.0)
    i, j = (touching[part] for part in np.triu_indices(len(touching), 1))
    apart = np.sqrt(((contacts[i] - contacts[j]) ** 2).sum(axis=1))
    first = np.searchsorted(lengths, apart - _LENGTHS_ALIKE)
    last = np.searchsorted(lengths, apart + _LENGTHS_ALIKE, side="right")
    good = (apart >= _LEAST_LENGTH) & (last > first)
    return np.stack([i, j, first, last], axis=1)[good].astype(np.int64)


def _at_heights(
    space: SE2Space,
    surface: FloatArray,
    normals: FloatArray,
    contacts: FloatArray,
    values: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Surface points in the order of their heights, and of each contact those that can meet it."""
    heights = (surface * space.axis).sum(axis=1)
    order = np.argsort(heights, kind="stable")
    upward = (space.resting_rotation * space.axis[:, None]).sum(axis=0)
    wanted = (contacts * upward).sum(axis=1) + space.offset
    reach = _LENGTHS_ALIKE + np.abs(values)
    first = np.searchsorted(heights[order], wanted - reach)
    last = np.searchsorted(heights[order], wanted + reach, side="right")
    singles = np.stack([np.arange(len(contacts)), first, last], axis=1)
    return order, singles[last > first]
