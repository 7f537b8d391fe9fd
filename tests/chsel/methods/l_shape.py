"""A body without symmetry, and what is known of it: a scene that tests of methods share."""

from __future__ import annotations

import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.sdf_grid import SdfGrid

TRUTH = compose(axis_angle(np.array([0.0, 0.6, 0.8]), np.array(0.7)), np.array([0.2, 0.1, 0.3]))
STANDING = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(2.0)), np.array([0.2, 0.1, 0.3]))
WORKSPACE = Workspace((-0.1, -0.2, 0.0), (0.5, 0.4, 0.6))
SIDE = 0.025


def _l_shape() -> trimesh.Trimesh:
    parts = [
        trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [0.2, 0.06, 0.05]])),
        trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [0.06, 0.14, 0.05]])),
        trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [0.06, 0.06, 0.1]])),
    ]
    return trimesh.boolean.union(parts, engine="manifold")


MESH = _l_shape()
GRID = SdfGrid.from_mesh(MESH, 0.01)


def known_points(world_from_object: FloatArray, contacts: int) -> KnownPoints:
    """Contacts, and the free voxels around them that miss the object."""
    surface = trimesh.sample.sample_surface(MESH, contacts, seed=1)[0]
    lower, upper = WORKSPACE.bounds
    counts = np.rint((upper - lower) / SIDE).astype(int)
    free = lower + SIDE * (0.5 + np.indices(counts).reshape(3, -1).T)
    sdf, _ = GRID.query(apply(inverse(world_from_object), free))
    return KnownPoints(free=free[sdf.numpy() > SIDE], known=apply(world_from_object, surface))
