"""How well a surface, rotated about its centroid, matches itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.plausible.surface_distance import surface_points
from chsel.problem.poses import rotation_matrices
from chsel.problem.streams import StreamKey

if TYPE_CHECKING:
    import trimesh

TOLERANCE = 0.0085  # of the diameter
_TESTED = 1000  # points by which a rotation is judged
_POINTS = 20_000  # points that mark the cells of the coarse grid
_CELLS = 48  # of the coarse grid, along each axis
_AT_ONCE = 2000  # rotations
_MOST_FACES = 100_000  # above this, vertices are merged
_MERGED = 128  # cells along the longest side
_ON_SURFACE = 1e-6  # of the radius: nearer, the face's normal is the better direction
_DAMPING = 1e-4


class RotatedSurface:
    """The surface of a mesh about its centroid, at unit radius.

    A rotation matches if the root mean square distance from the surface, of points of it that are
    rotated, is at most 0.85 % of the diameter, which is twice the distance from the centroid to the
    farthest vertex. Scans of boxes, cans and bottles that are symmetric by design have up to
    0.66 %. A hammer rotated by half a turn about its handle has 1.1 %, a tapered can turned upside
    down 1.2 %.
    """

    centre: FloatArray  # (3,), the surface's centroid in the frame of the mesh, m
    radius: float  # from the centroid to the farthest vertex, m; 0 for a mesh without an area
    corners: FloatArray  # (F, 3, 3), of each face
    normals: FloatArray  # (F, 3), unit
    areas: FloatArray  # (F,), shares of the whole

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        """Only centre and radius are set for a mesh without an area."""
        import igl
        import trimesh

        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
        corners, normals = _corners_normals(vertices, faces)
        areas = np.sqrt((normals**2).sum(axis=1))  # twice the areas of faces
        self.centre, self.radius = corners.reshape(-1, 3).mean(axis=0), 0.0
        if not areas.sum() > 0.0:
            return
        self.centre = (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / areas.sum()
        if len(faces) > _MOST_FACES:
            vertices, faces = _merged(vertices, faces)
            corners, normals = _corners_normals(vertices, faces)
            areas = np.sqrt((normals**2).sum(axis=1))
        self.radius = float(np.sqrt(((corners - self.centre) ** 2).sum(axis=-1)).max())
        self.corners = (corners - self.centre) / self.radius
        self.normals = normals / np.maximum(areas, 1e-300)[:, None]
        self.areas = areas / areas.sum()
        self._vertices = np.ascontiguousarray((vertices - self.centre) / self.radius)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        unit = trimesh.Trimesh(self._vertices, self._faces, process=False)
        self._points = surface_points(unit, _POINTS, StreamKey(0, 0))  # (P, 3)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def errors(self, turns: FloatArray, count: int = _TESTED) -> FloatArray:
        """Root mean square distances (T,) under rotations (T, 3, 3), in units of the tolerance."""
        _, squared, _, _ = self._closest(turns, count)
        return np.sqrt(squared.mean(axis=1)) / (2.0 * TOLERANCE)

    def aligned(self, turns: FloatArray, *, steps: int, count: int) -> FloatArray:
        """Rotations (T, 3, 3) moved to the nearest one by which the surface matches itself best.

        By Gauss-Newton steps on the distances of rotated points from the surface.
        """
        for _ in range(steps):
            moved, squared, face, closest = self._closest(turns, count)
            distance = np.sqrt(squared)
            on_surface = (distance < _ON_SURFACE)[..., None]
            apart = moved - closest
            outward = apart / np.where(on_surface, 1.0, distance[..., None])
            direction = np.where(on_surface, self.normals[face], outward)
            distance = (apart * direction).sum(axis=-1)  # with a sign where the surface is crossed
            slope = np.cross(moved, direction)
            hessian = np.einsum("tni,tnj->tij", slope, slope) / count + _DAMPING * np.eye(3)
            gradient = np.einsum("tni,tn->ti", slope, distance) / count
            half = -0.5 * np.linalg.solve(hessian, gradient[..., None])[..., 0]
            quaternion = np.concatenate([half, np.ones((len(half), 1))], axis=1)
            quaternion /= np.sqrt((quaternion**2).sum(axis=1, keepdims=True))
            turns = rotation_matrices(quaternion) @ turns
        return turns

    def coarse_errors(self, turns: FloatArray, count: int = 128) -> FloatArray:
        """Mean distances (T,) of rotated points from the surface, of the diameter, by a grid."""
        empty = np.ones((_CELLS, _CELLS, _CELLS), dtype=bool)
        empty[_cells(self._points)] = False
        distance = distance_transform_edt(empty) / _CELLS
        means = np.empty(len(turns))
        for first in range(0, len(turns), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            moved = np.einsum("tij,nj->tni", turns[some], self._points[:count])
            means[some] = distance[_cells(moved)].mean(axis=1)
        return means

    def _closest(
        self, turns: FloatArray, count: int
    ) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """Rotated points (T, count, 3), their squared distances, nearest faces and points there."""
        moved = np.einsum("tij,nj->tni", turns, self._points[:count])
        squared, face, closest = self._tree.squared_distance(
            self._vertices, self._faces, moved.reshape(-1, 3)
        )
        each = moved.shape[:2]
        return moved, squared.reshape(each), face.reshape(each), closest.reshape(moved.shape)


def _cells(points: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Indices of the cells in which points (..., 3) of the unit ball are."""
    index = np.clip(((points + 1.0) * (_CELLS / 2)).astype(np.int64), 0, _CELLS - 1)
    return index[..., 0], index[..., 1], index[..., 2]


def _corners_normals(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Corners (F, 3, 3) of faces, and normals (F, 3) as long as twice their areas."""
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    return corners, np.cross(sides[:, 0], sides[:, 1])


def _merged(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3), those of a cell as their mean, and the faces (F, 3) that this leaves."""
    used = vertices[faces]
    lower, upper = used.min(axis=(0, 1)), used.max(axis=(0, 1))
    cell = np.floor((vertices - lower) * (_MERGED / (upper - lower).max())).astype(np.int64)
    key = (cell[:, 0] * (_MERGED + 1) + cell[:, 1]) * (_MERGED + 1) + cell[:, 2]
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, weights=vertices[:, axis]) for axis in range(3)]
    faces = index[faces]
    a, b, c = faces.T
    return np.stack(sums, axis=1) / count[:, None], faces[(a != b) & (b != c) & (c != a)]
