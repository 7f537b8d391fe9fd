"""The surface of a mesh that stands still: signed distances, nearest points and normals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply

if TYPE_CHECKING:
    import trimesh

_SAME = (
    1e-4  # m: faces that are no farther from a point than this beyond the nearest one meet there
)


class MeshSurface:
    """Exact signed distance to a fixed mesh in the world, its search tree built only once.

    The sign is that of the pseudonormal of the nearest face, edge or corner, which needs no more
    than the surface around it.
    """

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> None:
        import igl

        self._vertices = np.ascontiguousarray(apply(world_from_object, np.asarray(mesh.vertices)))
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        rotation = world_from_object[:3, :3].T
        self._face_normals = np.asarray(mesh.face_normals) @ rotation
        self._corner_normals = np.asarray(mesh.vertex_normals) @ rotation
        neighbours, _ = igl.triangle_triangle_adjacency(self._faces)
        across = np.where(neighbours[..., None] < 0, 0.0, self._face_normals[neighbours])
        self._edge_normals = self._face_normals[:, None] + across  # by face and first corner

    def distance(self, points: FloatArray) -> FloatArray:
        """Return unsigned distance (N,) in metres at points (N, 3)."""
        return np.sqrt(self._tree.squared_distance(self._vertices, self._faces, points)[0])

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return signed distances (N,) of points (N, 3), nearest points (N, 3), and normals (N, 3).

        A normal is that of the face with the nearest point; on an edge or a corner, of one of its
        faces.
        """
        import trimesh

        squared, face, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        triangles = self._vertices[self._faces[face]]
        weights = trimesh.triangles.points_to_barycentric(triangles, nearest)
        on_side = weights < 1e-9  # of the edge opposite to this corner
        normals = self._face_normals[face]
        edge = on_side.sum(axis=1) == 1
        opposite = np.argmax(on_side[edge], axis=1)
        normals[edge] = self._edge_normals[face[edge], (opposite + 1) % 3]
        corner = on_side.sum(axis=1) == 2
        heaviest = np.argmax(weights[corner], axis=1)
        normals[corner] = self._corner_normals[self._faces[face[corner], heaviest]]
        outside = ((points - nearest) * normals).sum(axis=1) >= 0.0
        return np.where(outside, 1.0, -1.0) * np.sqrt(squared), nearest, self._face_normals[face]

    def encloses(self, point: FloatArray) -> bool:
        """Return whether a point (3,) is inside."""
        return bool(self.closest(point[None])[0][0] < 0.0)

    def facing_normal(self, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the normal (3,) of the face nearest to a point (3,).

        Where faces meet, it is that of the one that faces most along a direction (3,).
        """
        import trimesh

        triangles = self._vertices[self._faces]
        points = np.broadcast_to(point, (len(triangles), 3))
        nearest = trimesh.triangles.closest_point(triangles, points)
        distance = np.sqrt(((nearest - point) ** 2).sum(axis=1))
        normals = self._face_normals[distance <= distance.min() + _SAME]
        facing: FloatArray = normals[np.argmax((normals * direction).sum(axis=1))]
        return facing
