"""Points on the surface of an object that is known by its signed distance grid alone."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from chsel.errors import SdfError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey

_CENTRE_POINTS = 1000
# The six tetrahedra of a cell, along its diagonal (Freudenthal, 1942): corners (6, 4, 3).
_TETRAHEDRA = np.array(
    [np.cumsum([(0, 0, 0), *np.eye(3, dtype=np.int64)[list(p)]], 0) for p in permutations(range(3))]
)
# Which edges the surface crosses, by how many corners are inside, those inside counted first.
_TRIANGLES = {
    1: (((0, 1), (0, 2), (0, 3)),),
    2: (((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2))),
    3: (((0, 3), (1, 3), (2, 3)),),
}


def surface_points(sdf: SdfGrid, count: int, stream: np.random.Generator) -> FloatArray:
    """Points (count, 3) in the object frame, metres, uniform by area on the surface of a grid.

    Drawn where the grid's values, linear on tetrahedra between its nodes, are zero, then moved by
    one Newton step onto the surface that the gradients show as well. Flat sides are exact, edges
    are cut by less than the resolution, parts thinner than it may be missing.
    Raises SdfError if no node is inside of the object.
    """
    triangles = sdf.derived("surface", lambda: _zero_level(sdf))
    if len(triangles) == 0:
        raise SdfError(
            "no node of the SDF grid is inside of the object; accepted: a resolution fine enough "
            "for one"
        )
    corner, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2]
    v = v - corner
    area = np.sqrt((np.cross(u, v) ** 2).sum(axis=1))
    reached = np.cumsum(area)
    chosen, root, share = stream.random((count, 3)).T
    index = np.searchsorted(reached, chosen * reached[-1], side="right")
    index = np.minimum(index, len(area) - 1)
    root = np.sqrt(root)[:, None]
    share = root * share[:, None]
    return _refined(sdf, corner[index] + (root - share) * u[index] + share * v[index])


def has_surface(sdf: SdfGrid) -> bool:
    """Whether some nodes of a grid are inside of the object, and some are not."""
    inside = sdf.values < 0.0
    return bool(inside.any() and not inside.all())


def object_centre(sdf: SdfGrid) -> FloatArray:
    """The mean (3,) of points on the surface of a grid, in the object frame."""
    return sdf.derived("centre", lambda: _centre(sdf))


def _centre(sdf: SdfGrid) -> FloatArray:
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    centre: FloatArray = surface_points(sdf, _CENTRE_POINTS, stream).mean(axis=0)
    return centre


def _refined(sdf: SdfGrid, points: FloatArray) -> FloatArray:
    """Points (P, 3) moved by - s n, with s = sum w_i (s_i + g_i . (x - x_i) / 2) over 8 nodes.

    Where the surface is curved, interpolated values err to one side and values continued along
    gradients as much to the other: their mean errs by the third order of the resolution.
    """
    cell = (points - sdf.origin) / sdf.resolution
    base = np.minimum(np.floor(cell), np.array(sdf.shape) - 2).astype(np.int64)
    signed, normal = np.zeros(len(points)), np.zeros(points.shape)
    for corner in np.ndindex(2, 2, 2):
        away = cell - (base + corner)
        near = 1.0 - np.abs(away)
        weight = near[:, 0] * near[:, 1] * near[:, 2]
        i, j, k = (base + corner).T
        gradient = sdf.gradients[i, j, k]
        slope = gradient * away * sdf.resolution
        along = slope[:, 0] + slope[:, 1] + slope[:, 2]
        signed += weight * (sdf.values[i, j, k] + 0.5 * along)
        normal += weight[:, None] * gradient
    size = np.sqrt((normal**2).sum(axis=1))
    step = np.minimum(np.maximum(signed, -sdf.resolution), sdf.resolution)
    return points - (step / np.maximum(size, 0.1))[:, None] * normal  # where gradients cancel, less


def _zero_level(sdf: SdfGrid) -> FloatArray:
    """Triangles (T, 3, 3) of the surface, in the order of the cells."""
    inside = sdf.values < 0.0
    nx, ny, nz = sdf.shape
    offsets = list(np.ndindex(2, 2, 2))
    corners = [inside[i : nx - 1 + i, j : ny - 1 + j, k : nz - 1 + k] for i, j, k in offsets]
    crossed = np.logical_or.reduce(corners) & ~np.logical_and.reduce(corners)
    nodes = np.argwhere(crossed)[:, None, None] + _TETRAHEDRA  # (cells, 6, 4, 3)
    return np.concatenate(
        [_triangles(sdf, nodes.reshape(-1, 4, 3), n, edges) for n, edges in _TRIANGLES.items()]
    )


def _triangles(
    sdf: SdfGrid, nodes: IntArray, inside: int, triangles: tuple[tuple[tuple[int, int], ...], ...]
) -> FloatArray:
    """The triangles (T, 3, 3) in those of tetrahedra (P, 4, 3) with so many corners inside."""
    values = sdf.values[nodes[..., 0], nodes[..., 1], nodes[..., 2]]
    mine = (values < 0.0).sum(axis=1) == inside
    nodes, values = nodes[mine], values[mine]
    order = np.argsort(values >= 0.0, axis=1, kind="stable")
    values = np.take_along_axis(values, order, axis=1)
    places = sdf.origin + np.take_along_axis(nodes, order[..., None], axis=1) * sdf.resolution
    made = np.empty((len(nodes), len(triangles), 3, 3))
    for t, edges in enumerate(triangles):
        for e, (a, b) in enumerate(edges):
            share = values[:, a] / (values[:, a] - values[:, b])
            made[:, t, e] = places[:, a] + share[:, None] * (places[:, b] - places[:, a])
    return made.reshape(-1, 3, 3)
