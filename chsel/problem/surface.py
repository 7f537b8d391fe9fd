"""The surface of an object, from its grid alone, and how far the surfaces of poses are apart."""

from __future__ import annotations

from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import SdfError
from chsel.numerics.arrays import FloatArray, IntArray, evenly_spaced
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled
from chsel.numerics.pose_tuples import moved, pose_at
from chsel.numerics.threads import parallel_for
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.sdf_lookup import (
    distance_between_nodes,
    distance_beyond_box,
    distance_field,
    distance_with_gradient,
    value_between_nodes,
)
from chsel.problem.streams import Purpose, StreamKey

_CENTRE_POINTS = 1000
_AT_ONCE = 256  # points that are located together
_POSES_AT_ONCE = 16  # whose distances are looked up before they are summed, as long as in a cache
_LOOKUPS_PER_THREAD = 6400  # fewer are done before another thread wakes up
_PART = 1000  # cells that are cut at once
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))  # (8, 3) of a cell
# The six tetrahedra of a cell, along its diagonal (Freudenthal, 1942): corners (6, 4), by number.
_TETRAHEDRA = np.array(
    [np.cumsum([0, *np.array([4, 2, 1])[list(p)]]) for p in permutations(range(3))]
)
# Edges that the surface crosses, by the number of corners inside, when these are numbered first.
_TRIANGLES = {
    1: (((0, 1), (0, 2), (0, 3)),),
    2: (((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2))),
    3: (((0, 3), (1, 3), (2, 3)),),
}


def _crossed_edges() -> IntArray:
    """Return the corners (3, 2, 192) of a cell at both ends of a triangle's three crossed edges.

    192: by tetrahedron (6), its corners inside as bits (16), and which of up to two triangles.
    """
    edges = np.zeros((6, 16, 2, 3, 2), dtype=np.int64)
    for bits in range(1, 15):
        inside = [bits >> corner & 1 for corner in range(4)]
        order = np.argsort(np.logical_not(inside), kind="stable")
        for t, triangle in enumerate(_TRIANGLES[sum(inside)]):
            edges[:, bits, t] = _TETRAHEDRA[:, order[np.array(triangle)]]
    return np.moveaxis(edges.reshape(-1, 3, 2), 0, -1)


_CROSSED = _crossed_edges()
_INSIDE = np.array([bits.bit_count() for bits in range(16)])  # corners, by their bits


class ZeroLevel(NamedTuple):
    """Triangles of the surface of a grid, those in tetrahedra with one corner inside first."""

    cells: IntArray  # (T,) first node of each triangle's cell, by number
    edges: IntArray  # (T,) which of _CROSSED its corners are on, by number
    reached: FloatArray  # (T,) twice the area up to the end of each, square metres


def surface_points(sdf: SdfGrid, count: int, *, stream: np.random.Generator) -> FloatArray:
    """Return points (count, 3) in the object frame, metres, uniform by area on the surface.

    Drawn on the zero level of the grid's values, linear on tetrahedra between nodes, then moved by
    one Newton step that uses the gradients too. Flat sides are exact, edges are cut off by less
    than the resolution, and parts thinner than the resolution may be missing.
    Raises SdfError if no node is inside of the object.
    """
    level = sdf.derived("surface", lambda: _zero_level(sdf))
    reached = level.reached
    if len(reached) == 0:
        raise SdfError(
            "no node of the SDF grid is inside of the object; accepted: a resolution fine enough "
            "for one"
        )
    chosen, root, share = stream.random((count, 3)).T
    index = np.searchsorted(reached, chosen * reached[-1], side="right")
    index = np.minimum(index, len(reached) - 1)
    corner, u, v = _triangles(sdf, level.cells[index], edges=level.edges[index])
    root = np.sqrt(root)[:, None]
    share = root * share[:, None]
    return _refined(sdf, corner + (root - share) * u + share * v)


def has_surface(sdf: SdfGrid) -> bool:
    """Return whether some nodes of a grid are inside of the object, and some are not."""
    inside = sdf.values < 0.0
    return bool(inside.any() and not inside.all())


def object_centre(sdf: SdfGrid) -> FloatArray:
    """Return the mean (3,) of points on the surface of a grid, in the object frame."""
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    return sdf.derived(
        "centre", lambda: surface_points(sdf, _CENTRE_POINTS, stream=stream).mean(axis=0)
    )


def _refined(sdf: SdfGrid, points: FloatArray) -> FloatArray:
    """Return points (P, 3) - s n, with s = sum w_i (s_i + g_i . (x - x_i) / 2) over 8 nodes.

    On a curved surface, interpolated values err to one side and values extrapolated along gradients
    as much to the other; the error of their mean is of third order in the resolution.
    """
    cell = (points - sdf.origin) / sdf.resolution
    base = sdf.lowest_nodes(cell).astype(np.int64)
    signed = np.zeros(len(points))
    normal = np.zeros(points.shape)
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
    return points - (step / np.maximum(size, 0.1))[:, None] * normal  # less if gradients cancel


def _zero_level(sdf: SdfGrid) -> ZeroLevel:
    """Return the triangles of the surface, by the corners inside, in the order of the cells."""
    inside = sdf.values < 0.0
    nx, ny, nz = sdf.shape
    corners = [inside[i : nx - 1 + i, j : ny - 1 + j, k : nz - 1 + k] for i, j, k in _CORNERS]
    crossed = np.logical_or.reduce(corners) & ~np.logical_and.reduce(corners)
    cells = np.ravel_multi_index(np.nonzero(crossed), sdf.shape)
    parts: dict[int, list[tuple[IntArray, ...]]] = {count: [] for count in _TRIANGLES}
    for first in range(0, len(cells) or 1, _PART):
        part = cells[first : first + _PART]
        of_corners = inside.ravel()[part[:, None] + _after(sdf)][:, _TETRAHEDRA]
        bits = (of_corners * [1, 2, 4, 8]).sum(axis=2)  # (cells, 6)
        for count, triangles in _TRIANGLES.items():
            where, tetrahedron = np.nonzero(_INSIDE[bits] == count)
            numbers = 2 * (16 * tetrahedron + bits[where, tetrahedron])
            of_cell = part[where].repeat(len(triangles))
            edges = (numbers[:, None] + np.arange(len(triangles))).ravel()
            _, u, v = _triangles(sdf, of_cell, edges=edges)
            area = np.sqrt((np.cross(u, v) ** 2).sum(axis=1))
            parts[count].append((of_cell.astype(np.int32), edges.astype(np.uint8), area))
    columns = zip(*(part for of_count in parts.values() for part in of_count), strict=True)
    of_cell, edges, area = map(np.concatenate, columns)
    return ZeroLevel(of_cell, edges=edges, reached=np.cumsum(area))


def _triangles(
    sdf: SdfGrid, cells: IntArray, *, edges: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a corner (T, 3) of triangles, and the ways (T, 3) from it to the others."""
    ends = _CROSSED[..., edges]  # (3, 2, T)
    values = sdf.values.ravel()[cells + _after(sdf)[ends]]
    nodes = np.array(np.unravel_index(cells, sdf.shape))[:, None, None] + _CORNERS.T[:, ends]
    places = sdf.origin[:, None, None, None] + nodes * sdf.resolution  # (3, 3, 2, T)
    share = values[:, 0] / (values[:, 0] - values[:, 1])
    corners = places[:, :, 0] + share * (places[:, :, 1] - places[:, :, 0])  # (3, 3, T)
    first, second, third = np.moveaxis(corners, 0, -1)
    return first, second - first, third - first


def _after(sdf: SdfGrid) -> IntArray:
    """Return numbers of nodes (8,) from a cell's first one to its corners."""
    return np.ravel_multi_index(tuple(_CORNERS.T), sdf.shape)


_POINTS = 100


def outline_distances(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Return distances (B, B), metres, of the object's surfaces in poses from each other.

    Root mean square over points of both surfaces: 0 between poses that a symmetry maps to each
    other. As exact as the grid's interpolation, a fraction of its resolution.
    """
    places = outline_in_world(sdf, poses)[:, ::2]  # (B, Q, 3): both surfaces have as many
    count, size = places.shape[:2]
    squares = np.empty((count, count))
    for first in range(0, count, _POSES_AT_ONCE):
        some = slice(first, first + _POSES_AT_ONCE)
        off = signed_distances(sdf, poses[some], points=places.reshape(-1, 3))
        squares[some] = in_order(off.reshape(-1, count, size) ** 2)
    squares /= max(size, 1)
    apart: FloatArray = np.sqrt(0.5 * (squares + squares.T))
    np.fill_diagonal(apart, 0.0)
    return apart


def surface_spread(distances: FloatArray, weights: FloatArray | None = None) -> float:
    """Return root mean square distance of the surfaces in two poses drawn from a set, metres.

    This is the spread of hypotheses and of beliefs. distances (B, B), metres: `outline_distances`.
    weights (B,): with which poses are drawn, each again; None: all alike.
    """
    if weights is None:
        weights = np.full(len(distances), 1.0 / len(distances))
    return float(np.sqrt(in_order(weights * in_order(weights * distances**2))))


def outline_distances_to(sdf: SdfGrid, poses: Poses, *, other: Poses) -> FloatArray:
    """Return distances (B,), metres, of the object's surface in each pose from that in another.

    As in `outline_distances`. other: a single pose.
    """
    there = outline_in_world(sdf, poses)  # (B, Q, 3)
    count, size = there.shape[:2]
    forth = signed_distances(sdf, other, points=there.reshape(-1, 3)).reshape(count, size)
    back = signed_distances(sdf, poses, points=outline_in_world(sdf, other)[0])  # (B, Q)
    squares = in_order(forth**2) + in_order(back**2)
    return np.sqrt(squares / (2 * max(size, 1)))


def outline_in_world(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Return points (B, Q, 3) on the object's surface in each pose; Q is 0 without a surface."""
    turns = np.swapaxes(poses.rotations, 1, 2)
    return rotated(turns[:, None], outline_in_object(sdf) - poses.translations[:, None])


def outline_in_object(sdf: SdfGrid) -> FloatArray:
    """Return points (Q, 3) on the object's surface, object frame."""
    return sdf.derived("outline", lambda: _outline(sdf))


def signed_distances(sdf: SdfGrid, poses: Poses, *, points: FloatArray) -> FloatArray:
    """Return signed distances (B, N), metres, of world points (N, 3), at most FARTHEST."""
    return np.minimum(surface_distances(sdf, poses, points=points), FARTHEST)


def surface_gradients(sdf: SdfGrid, poses: Poses, *, points: FloatArray) -> FloatArray:
    """Return gradients (B, N, 3) of the signed distance at world points (N, 3), object frame.

    They point out of the object, and are shorter than 1 where faces meet.
    """
    field = distance_field(sdf, "trilinear", outside="surface_point")
    numbers = np.array(poses.numbers)
    places = np.array(points)
    gradients = np.empty((len(poses), len(points), 3))

    def run(first: int, last: int, _: Any) -> None:
        gradients_in_poses(field, numbers, places, gradients, first, last)

    least = 1 + _LOOKUPS_PER_THREAD // max(len(points), 1)
    parallel_for(run, len(poses), scratch=lambda: None, least=least)
    return gradients


def in_order(values: FloatArray) -> FloatArray:
    """Return sums along the last axis, added in their order: the same on every machine."""
    if values.shape[-1] == 0:
        return np.zeros(values.shape[:-1])
    return np.cumsum(values, axis=-1)[..., -1]


def _outline(sdf: SdfGrid) -> FloatArray:
    """Return points (Q, 3) on the object's surface, object frame; none without a surface."""
    if has_surface(sdf):
        return surface_points(sdf, _POINTS, stream=StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))
    near = np.argwhere(np.abs(sdf.values) < 2.0 * sdf.resolution)  # of objects thinner than that
    near = near[evenly_spaced(len(near), _POINTS)]
    i, j, k = near.T
    away = sdf.values[i, j, k][:, None] * sdf.gradients[i, j, k]
    points: FloatArray = sdf.origin + near * sdf.resolution - away
    return points


def surface_distances(sdf: SdfGrid, poses: Poses, *, points: FloatArray) -> FloatArray:
    """Return signed distances (B, N), metres, of world points (N, 3) to the surface in poses."""
    field = distance_field(sdf, "trilinear", outside="surface_point")
    numbers = np.array(poses.numbers)
    columns = np.array(points.T, order="C")
    distances = np.empty((len(poses), len(points)))

    def run(first: int, last: int, places: Places) -> None:
        distances_from_surface(field, numbers, columns, places, distances, first, last)

    least = 1 + _LOOKUPS_PER_THREAD // max(len(points), 1)
    parallel_for(run, len(poses), scratch=lambda: places_for(_AT_ONCE), least=least)
    return distances


@compiled
def gradients_in_poses(
    field: Any, poses: Any, places: Any, out: Any, first: Any, last: Any
) -> None:
    """Fill out (B, K, 3) with the gradients at world points (K, 3) in poses (B, 12)."""
    for b in range(first, last):
        pose = pose_at(poses, b)
        for k in range(len(places)):
            x, y, z = places[k, 0], places[k, 1], places[k, 2]
            _, nx, ny, nz = distance_with_gradient(field, pose, x, y, z)
            out[b, k, 0], out[b, k, 1], out[b, k, 2] = nx, ny, nz


@compiled
def distances_from_surface(
    field: Any, poses: Any, points: Any, places: Any, out: Any, first: Any, last: Any
) -> None:
    """Fill out (B, K) with the distances of world points (3, K) in poses (B, 12), first to last."""
    box, table = field.box, field.table
    across, along = int(box.across), int(box.along)
    size = len(places.cell)
    for b in range(first, last):
        pose = pose_at(poses, b)
        for begin in range(0, points.shape[1], size):
            count = min(size, points.shape[1] - begin)
            x, y, z = points[0, begin:], points[1, begin:], points[2, begin:]
            locate(pose, box, x, y, z, places, count)
            for n in range(count):
                u, v, w = places.u[n], places.v[n], places.w[n]
                at = places.cell[n]
                out[b, begin + n] = value_between_nodes(table, at, across, along, u, v, w)
            for n in range(count):
                if places.beyond[n] > 0.0:
                    u, v, w = places.u[n], places.v[n], places.w[n]
                    _, p, q, r = distance_between_nodes(box, table, places.cell[n], u, v, w)
                    inside = out[b, begin + n], p, q, r
                    a, c, d = moved(pose, x[n], y[n], z[n])
                    beyond = distance_beyond_box(field.box_distance, box, inside, a, c, d)
                    out[b, begin + n] = beyond[0]
