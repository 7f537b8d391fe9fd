"""Distances of an object's surface in plausible poses from its surface in estimated ones.

    d(b, p) = 1/Q sum_q (1000 |s_mesh(X_b Y_p u_q)|)^2   in mm^2

of estimates X (object_from_world), plausible poses Y (world_from_object) and Q points u on the
surface; one-directional, s the distance to the mesh (CHSEL, Sec. V).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np

from chsel.errors import PoseError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.cell_set import locate, places_for
from chsel.numerics.compiler import compiled
from chsel.numerics.pose_tuples import composed, pose_at
from chsel.numerics.threads import parallel_for
from chsel.problem.poses import Poses, product, rotated, stacked
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_field, distance_in_place
from chsel.problem.settings import CheckedSettings, at_most, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, uniforms

if TYPE_CHECKING:
    import trimesh

METHODS = ("nearest", "exact", "grid")
SQUARE_MILLIMETRES = 1e6  # in a square metre
_CANDIDATES = 4  # of each pose, which the grid says are the nearest of the other set
_POINTS_TO_GIVE_UP = (25, 100, 250)  # after which a pair that is too far is given up
_POINTS_AT_ONCE = 200_000
_MOST_POINTS = 1_000_000


@dataclass(frozen=True)
class DistanceSettings(CheckedSettings):
    """Settings of surface distances."""

    points: Annotated[int, positive, at_most(_MOST_POINTS)] = 500  # Q, 200 in the paper
    # "exact" measures to the mesh for every pair of poses; "nearest" only for the few pairs that
    # the interpolated SDF grid says are the nearest, which are all that the metrics read, and is
    # 10 to 100 times faster; "grid" never.
    method: Annotated[str, one_of(*METHODS)] = "nearest"


class SurfaceDistance:
    """Distances between poses of one object."""

    def __init__(
        self,
        sdf: SdfGrid,
        mesh: trimesh.Trimesh | None,
        *,
        points: FloatArray,
        settings: DistanceSettings | None = None,
    ) -> None:
        """points (Q, 3): on the surface, in the object's frame, see surface_points.

        mesh: in metres; may be None for method "grid".
        """
        import igl

        self.settings = settings = settings or DistanceSettings()
        if mesh is None and settings.method != "grid":
            raise SettingError(f"method {settings.method} needs a mesh; accepted without: grid")
        self._points = np.ascontiguousarray(points.T)
        self._field = distance_field(sdf, "trilinear", outside="surface_point")
        if mesh is not None:
            self._vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
            self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
            self._tree = igl.AABB()
            self._tree.init(self._vertices, self._faces)

    def between(self, object_from_world: FloatArray, world_from_object: FloatArray) -> FloatArray:
        """Return d (B, P) in mm^2 of estimates (B, 4, 4) and plausible poses (P, 4, 4).

        With method "nearest", the least of every row and column are exact; others are the grid's,
        or where that is too low a bound above the least.
        """
        to_object, to_world = _finite(object_from_world), _finite(world_from_object)
        if self.settings.method == "exact":
            pairs = np.ones((len(to_object), len(to_world)), dtype=bool)
            return self._exact(to_object, to_world, pairs=pairs).reshape(pairs.shape)
        distances = self._by_grid(Poses.of(to_object).numbers, Poses.of(to_world).numbers)
        if self.settings.method == "nearest" and distances.size:
            first = _least(distances, 1)
            others = _least(distances, _CANDIDATES) & ~first
            distances[first] = self._exact(to_object, to_world, pairs=first)
            known = np.where(first, distances, np.inf)
            limit = np.maximum(known.min(axis=1)[:, None], known.min(axis=0))
            found = self._exact(to_object, to_world, pairs=others, limit=limit)
            given_up = found > limit[others]
            distances[others] = np.where(given_up, np.maximum(distances[others], found), found)
        return distances

    def _by_grid(self, to_object: FloatArray, to_world: FloatArray) -> FloatArray:
        """Return distances (B, P) by the grid, of poses (B, 12) and (P, 12)."""
        total = np.empty((len(to_object), len(to_world)))
        run = partial(fill_mean_squares, self._field, self._points, to_object, to_world, total)
        parallel_for(run, len(total), scratch=lambda: places_for(self._points.shape[1]))
        return total * SQUARE_MILLIMETRES

    def _exact(
        self,
        to_object: FloatArray,
        to_world: FloatArray,
        *,
        pairs: BoolArray,
        limit: FloatArray | None = None,
    ) -> FloatArray:
        """Return distances (N,) to the mesh of flagged pairs (B, P) of poses, row by row.

        limit (B, P), mm^2: of a pair that is farther, a lower bound above it, by fewer points.
        """
        rows, columns = np.nonzero(pairs)
        count = self._points.shape[1]
        most = np.full(len(rows), np.inf) if limit is None else limit[rows, columns]
        most = most * (count / SQUARE_MILLIMETRES)  # of the sum, m^2
        stops = [count] if limit is None else [*(n for n in _POINTS_TO_GIVE_UP if n < count), count]
        total = np.empty(len(rows))
        size = max(1, _POINTS_AT_ONCE // count)
        for start in range(0, len(rows), size):
            squares = np.zeros((min(size, len(rows) - start), count))
            left = np.arange(len(squares))
            first = 0
            for stop in stops:
                row, column = rows[start + left], columns[start + left]
                points = self._points[:, first:stop]
                squares[left, first:stop] = self._squared(to_object[row], to_world[column], points)
                left = left[squares[left].sum(axis=1) <= most[start + left]]
                first = stop
            total[start : start + len(squares)] = squares.mean(axis=1)
        return total * SQUARE_MILLIMETRES

    def _squared(self, left: FloatArray, right: FloatArray, points: FloatArray) -> FloatArray:
        """Return squared distances (N, K) to the mesh, m^2, of points (3, K) moved by N pairs."""
        turn = product(left[:, :3, :3], right[:, :3, :3])[:, None]
        shift = rotated(left[:, :3, :3], right[:, :3, 3]) + left[:, :3, 3]
        moved = (rotated(turn, points.T) + shift[:, None]).reshape(-1, 3)
        squared = self._tree.squared_distance(self._vertices, self._faces, moved)[0]
        return np.asarray(squared).reshape(len(left), points.shape[1])


def surface_points(mesh: trimesh.Trimesh, count: int, *, key: StreamKey) -> FloatArray:
    """Return points (count, 3) spread over the surface of a mesh at random, uniformly by area."""
    corners = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    areas = np.sqrt((np.cross(b - a, c - a) ** 2).sum(axis=1))
    drawn = uniforms(key.stream(Purpose.METRIC_POINTS), 0.0, upper=1.0, shape=(count, 3))
    until = np.cumsum(areas)
    face = np.searchsorted(until, drawn[:, 0] * until[-1], side="right")
    face = np.minimum(face, len(areas) - 1)
    root = np.sqrt(drawn[:, 1:2])
    u, v = 1.0 - root, root * drawn[:, 2:3]
    return u * a[face] + (1.0 - u - v) * b[face] + v * c[face]


def _finite(transforms: FloatArray) -> FloatArray:
    """Return transforms (B, 4, 4) as numbers; PoseError for another shape, or not finite ones."""
    transforms = stacked(transforms)
    finite = np.isfinite(transforms[:, :3]).all(axis=(1, 2))
    if not finite.all():
        raise PoseError(f"pose {int(np.argmin(finite))} is not finite; accepted: finite transforms")
    return transforms


def _least(distances: FloatArray, most: int) -> BoolArray:
    """Return flags (B, P) of at most so many least entries of every row and of every column."""
    flags = np.zeros(distances.shape, dtype=bool)
    for axis in range(2):
        count = min(most, distances.shape[axis])
        least = np.argsort(distances, axis=axis, kind="stable").take(range(count), axis=axis)
        np.put_along_axis(flags, least, True, axis=axis)
    return flags


@compiled
def fill_mean_squares(field, points, to_object, to_world, out, first, last, places):
    """Fill rows first to last of out (B, P) with the means of s^2 over moved points (3, Q), m^2.

    Points are moved by every pose of to_world (P, 12), then by every one of to_object (B, 12).
    """
    xs, ys, zs = points[0], points[1], points[2]
    for b in range(first, last):
        for p in range(len(to_world)):
            move = composed(pose_at(to_object, b), pose_at(to_world, p))
            locate(move, field.box, xs, ys, zs, places, len(xs))
            total = 0.0
            for n in range(len(xs)):
                s = distance_in_place(field, move, xs[n], ys[n], zs[n], places, n)[0]
                total += s * s
            out[b, p] = total / len(xs)
