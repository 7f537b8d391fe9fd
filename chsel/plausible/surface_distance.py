"""How far an object's surface in a plausible pose is from its surface in an estimated one.

    d(b, p) = 1/Q sum_q (1000 |s_mesh(X_b Y_p u_q)|)^2   in mm^2

of estimates X (object_from_world), plausible poses Y (world_from_object) and Q points u on the
surface; one-directional, s the distance to the mesh (CHSEL, Sec. V).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import PoseError, SettingError, require_at_most, require_choice, require_positive
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.threads import spread
from chsel.plausible.surface_kernels import (
    mean_squares,
    moved_for,
    moved_points,
    relative_moves,
)
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_field
from chsel.problem.streams import Purpose, StreamKey, uniforms

if TYPE_CHECKING:
    import trimesh


METHODS = ("nearest", "exact", "grid")
SQUARE_MILLIMETRES = 1e6  # in a square metre
_CANDIDATES = 4  # of each pose, which the grid says are the nearest of the other set
_POINTS_AT_ONCE = 200_000
_MOST_POINTS = 1_000_000


@dataclass(frozen=True)
class DistanceSettings:
    """points: Q, 200 in the paper. method: "exact" measures to the mesh for every pair of poses;
    "nearest" only for the few pairs that the interpolated SDF grid says are the nearest, which
    are all that the metrics read, and is 10 to 100 times faster; "grid" never. bidirectional: the
    mean of d and the same with the roles of the two poses swapped.
    """

    points: int = 500
    method: str = "nearest"
    bidirectional: bool = False

    def __post_init__(self) -> None:
        require_positive("points", self.points)
        require_at_most("points", self.points, _MOST_POINTS)
        require_choice("method", self.method, METHODS)


class SurfaceDistance:
    """Distances between poses of one object. mesh: in metres; may be None for method "grid"."""

    def __init__(
        self,
        sdf: SdfGrid,
        mesh: trimesh.Trimesh | None,
        points: FloatArray,
        settings: DistanceSettings | None = None,
    ) -> None:
        """points (Q, 3): on the surface, in the object's frame, see surface_points."""
        import igl

        self.settings = settings = settings or DistanceSettings()
        if mesh is None and settings.method != "grid":
            raise SettingError(f"method {settings.method} needs a mesh; accepted without: grid")
        self._points = np.ascontiguousarray(points.T)
        self._field = distance_field(sdf, "trilinear", "surface_point")
        if mesh is not None:
            self._vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
            self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
            self._tree = igl.AABB()
            self._tree.init(self._vertices, self._faces)

    def between(self, object_from_world: FloatArray, world_from_object: FloatArray) -> FloatArray:
        """d (B, P) in mm^2 of estimates (B, 4, 4) and plausible poses (P, 4, 4).

        With method "nearest", the least of every row and column are exact, others are the grid's.
        """
        to_object, to_world = _finite_poses(object_from_world), _finite_poses(world_from_object)
        count, other = len(to_object), len(to_world)
        if self.settings.method == "exact":
            rows, columns = np.indices((count, other)).reshape(2, -1)
            return self._exact(to_object, to_world, rows, columns).reshape(count, other)
        distances = self._grid(to_object, to_world)
        if self.settings.method == "nearest" and distances.size:
            rows, columns = _nearest(distances)
            distances[rows, columns] = self._exact(to_object, to_world, rows, columns)
        return distances

    def _grid(self, to_object: FloatArray, to_world: FloatArray) -> FloatArray:
        """All distances (B, P) by the grid."""
        total = np.zeros((len(to_object), len(to_world)))
        ways = (False, True) if self.settings.bidirectional else (False,)
        for back in ways:
            out = np.empty_like(total)

            def run(first: int, last: int, scratch: Any, back: bool = back, out: Any = out) -> None:
                field, points = self._field, self._points
                mean_squares(field, points, to_object, to_world, back, out, first, last, scratch)

            spread(run, len(to_object), lambda: moved_for(self._points.shape[1]))
            total += out
        return total * (SQUARE_MILLIMETRES / len(ways))

    def _exact(
        self, to_object: FloatArray, to_world: FloatArray, rows: IntArray, columns: IntArray
    ) -> FloatArray:
        """Distances (N,) to the mesh of pairs of poses."""
        total = np.zeros(len(rows))
        ways = (False, True) if self.settings.bidirectional else (False,)
        count = self._points.shape[1]
        piece = max(1, _POINTS_AT_ONCE // count)
        for back in ways:
            for first in range(0, len(rows), piece):
                some = slice(first, first + piece)
                moves = np.empty((len(rows[some]), 12))
                relative_moves(to_object[rows[some]], to_world[columns[some]], back, moves)
                points = np.empty((len(moves), count, 3))
                moved_points(self._points, moves, points)
                squared = self._tree.squared_distance(
                    self._vertices, self._faces, points.reshape(-1, 3)
                )[0]
                total[some] += squared.reshape(len(moves), count).mean(axis=1)
        return total * (SQUARE_MILLIMETRES / len(ways))


def surface_points(mesh: trimesh.Trimesh, count: int, key: StreamKey) -> FloatArray:
    """Points (count, 3) spread over the surface of a mesh at random, uniformly by area."""
    corners = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    areas = np.sqrt((np.cross(b - a, c - a) ** 2).sum(axis=1))
    stream = key.stream(Purpose.METRIC_POINTS)
    drawn = uniforms(stream, 0.0, 1.0, (count, 3))
    until = np.cumsum(areas)
    face = np.searchsorted(until, drawn[:, 0] * until[-1], side="right")
    face = np.minimum(face, len(areas) - 1)
    root = np.sqrt(drawn[:, 1:2])
    u, v = 1.0 - root, root * drawn[:, 2:3]
    return u * a[face] + (1.0 - u - v) * b[face] + v * c[face]


def _finite_poses(transforms: FloatArray) -> FloatArray:
    poses = Poses.of(transforms).numbers
    if not np.isfinite(poses).all():
        row = int(np.argmin(np.isfinite(poses).all(axis=1)))
        raise PoseError(f"pose {row} is not finite; accepted: finite transforms")
    return poses


def _nearest(distances: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns (N,) of the few least entries of every row and of every column."""
    near = np.zeros(distances.shape, dtype=bool)
    for axis in range(2):
        count = min(_CANDIDATES, distances.shape[axis])
        least = np.argsort(distances, axis=axis, kind="stable").take(range(count), axis=axis)
        np.put_along_axis(near, least, True, axis=axis)
    rows, columns = np.nonzero(near)
    return rows, columns
