"""The hand that probes: its solid parts, and how far they reach forward."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, IntArray, digest, frozen
from chsel.numerics.compiler import compiled

if TYPE_CHECKING:
    import trimesh

CELL = 0.002  # metres: side of the cells of the front
_LARGEST = 2000  # cells, either way: a hand of 4 m


class HandFront(NamedTuple):
    """How far the hand reaches along its z axis, over cells of its x and y axes."""

    heights: FloatArray  # (X, Y), metres; -inf where there is no hand
    lower: FloatArray  # (2,): x and y of the first cell's corner, hand frame, metres
    cell: float  # side of a cell, metres


class HandShape:
    """The surface of a hand in its own frame, metres; it probes along its z axis.

    vertices (V, 3), faces (F, 3): triangles of one or more closed bodies.
    Raises SettingError for a hand without a face, or one of more than 4 m.
    """

    def __init__(self, vertices: Any, faces: Any) -> None:
        self.vertices: FloatArray = frozen("hand vertices", vertices, (None, 3), error=SettingError)
        self.faces: IntArray = frozen(
            "hand faces", faces, (None, 3), dtype=np.int64, error=SettingError
        )
        if len(self.faces) == 0 or self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise SettingError("the hand has no faces between its vertices; accepted: a mesh")
        sides = np.ptp(self.vertices[:, :2], axis=0)
        if (sides > CELL * (_LARGEST - 2)).any():
            raise SettingError(
                f"the hand is {sides.max():.3g} m wide; accepted: at most "
                f"{CELL * (_LARGEST - 2):.3g} m"
            )

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> HandShape:
        """The shape of a mesh in the hand's frame, metres."""
        return cls(mesh.vertices, mesh.faces)

    @cached_property
    def digest(self) -> str:
        """Digest of vertices and faces."""
        return digest(self.vertices, self.faces)

    @cached_property
    def front(self) -> HandFront:
        """The hand as seen from what it moves towards."""
        vertices = np.array(self.vertices)
        lower = vertices[:, :2].min(axis=0) - CELL
        counts = np.ceil((vertices[:, :2].max(axis=0) + CELL - lower) / CELL).astype(np.int64)
        heights = np.full(tuple(counts), -np.inf)
        front = HandFront(heights, lower, CELL)
        raise_front(front, vertices, np.array(self.faces))
        heights.setflags(write=False)
        return front

    @property
    def bounds(self) -> FloatArray:
        """Lower and upper corner (2, 3) in the hand's frame."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])


@compiled
def raise_front(front: Any, vertices: Any, faces: Any) -> None:
    """Raise the cells of a HandFront to the highest of the faces (F, 3) over their centres.

    Cells that hold a vertex are at least as high as it, however thin the faces around it are.
    """
    heights, cell = front.heights, front.cell
    x0, y0 = front.lower[0], front.lower[1]
    for v in range(len(vertices)):
        i, j = int((vertices[v, 0] - x0) / cell), int((vertices[v, 1] - y0) / cell)
        heights[i, j] = max(heights[i, j], vertices[v, 2])
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        double_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if double_area == 0.0:
            continue
        first_i = int((min(a[0], b[0], c[0]) - x0) / cell)
        last_i = int((max(a[0], b[0], c[0]) - x0) / cell)
        first_j = int((min(a[1], b[1], c[1]) - y0) / cell)
        last_j = int((max(a[1], b[1], c[1]) - y0) / cell)
        for i in range(first_i, last_i + 1):
            x = x0 + (i + 0.5) * cell
            for j in range(first_j, last_j + 1):
                y = y0 + (j + 0.5) * cell
                p = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / double_area
                q = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / double_area
                r = 1.0 - p - q
                if p >= 0.0 and q >= 0.0 and r >= 0.0:
                    heights[i, j] = max(heights[i, j], p * a[2] + q * b[2] + r * c[2])
