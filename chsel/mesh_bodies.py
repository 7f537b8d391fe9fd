"""How far the separate bodies of a mesh are apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from chsel.errors import MeshWarning

if TYPE_CHECKING:
    import trimesh

_NEAR = 0.5  # diameters of the largest body; a part of an object is nearer to its other parts
_MOST_BODIES = 1000  # the largest ones are compared


def check_bodies(mesh: trimesh.Trimesh, name: str) -> list[MeshWarning]:
    """A warning if bodies of a mesh (metres) are too far from one another for a single object.

    The distance between two bodies is that of the boxes around them, and bodies that are near to
    one another count as one.
    """
    lower, upper = _boxes(mesh)
    apart = np.maximum(np.maximum(lower[:, None] - upper, lower - upper[:, None]), 0.0)
    distance = np.sqrt((apart**2).sum(axis=2))  # (bodies, bodies)
    largest = float(np.sqrt(((upper - lower) ** 2).sum(axis=1)).max())
    count, group = connected_components(distance <= _NEAR * largest, directed=False)
    if count == 1:
        return []
    gap = float(distance[group[:, None] != group].min())
    text = (
        f"{name} has {count} bodies at least {gap:.3g} m apart, the largest of {largest:.3g} m; "
        "they are registered as one rigid object: remove what is not part of it"
    )
    return [MeshWarning("bodies_apart", text)]


def _boxes(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (bodies, 3) of the boxes around what faces connect, largest first."""
    a, b, c = np.asarray(mesh.faces).T
    edges = np.concatenate([a, b]), np.concatenate([b, c])
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(edges[0]), dtype=bool), edges), shape=(count, count))
    bodies, body = connected_components(graph, directed=False)
    vertices = np.asarray(mesh.vertices)[np.argsort(body, kind="stable")]
    starts = np.concatenate([[0], np.cumsum(np.bincount(body, minlength=bodies))[:-1]])
    lower, upper = np.minimum.reduceat(vertices, starts), np.maximum.reduceat(vertices, starts)
    largest_first = np.argsort(-((upper - lower) ** 2).sum(axis=1), kind="stable")[:_MOST_BODIES]
    return lower[largest_first], upper[largest_first]
