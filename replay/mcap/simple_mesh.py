"""A mesh of few triangles that looks like another one, for viewers that get it many times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chsel.numerics.arrays import FloatArray

if TYPE_CHECKING:
    import trimesh

MOST_FACES = 400
_FINEST, _COARSEST = 40, 4  # cells along the longest side of the bounds


@dataclass(frozen=True, eq=False)
class SimpleMesh:
    """A surface in the object's frame."""

    vertices: FloatArray
    """Positions (V, 3), metres."""
    faces: NDArray[np.int64]
    """Indices of vertices (F, 3)."""


def simple_mesh(mesh: trimesh.Trimesh, most: int = MOST_FACES) -> SimpleMesh:
    """The mesh, its vertices joined cell by cell of a grid until it has at most `most` faces."""
    simple = SimpleMesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))
    cells = _FINEST
    while len(simple.faces) > most and cells >= _COARSEST:
        simple = _joined(simple, cells)
        cells -= 1
    used, faces = np.unique(simple.faces[:most], return_inverse=True)
    return SimpleMesh(simple.vertices[used], faces.reshape(-1, 3))


def _joined(mesh: SimpleMesh, cells: int) -> SimpleMesh:
    """The vertices of each cell as one, their mean; without the faces that vanish."""
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    side = max(float((upper - lower).max()) / cells, np.finfo(np.float64).tiny)
    place = np.minimum(np.floor((mesh.vertices - lower) / side), cells - 1).astype(np.int64)
    cell = (place[:, 0] * cells + place[:, 1]) * cells + place[:, 2]
    _, joined, counts = np.unique(cell, return_inverse=True, return_counts=True)
    sums = [np.bincount(joined, weights=mesh.vertices[:, axis]) for axis in range(3)]
    vertices = np.stack(sums, axis=-1) / counts[:, None]
    faces = joined[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return SimpleMesh(vertices, faces[np.sort(first)])
