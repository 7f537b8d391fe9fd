"""Meshes with sharp edges and thin walls, metres, that tests of contacts and normals share."""

import numpy as np
import trimesh


def box():
    """A box of 80 x 60 x 50 mm about the origin."""
    return trimesh.creation.box((0.08, 0.06, 0.05))


def plate():
    """A plate of 100 x 70 x 2 mm about the origin."""
    return trimesh.creation.box((0.1, 0.07, 0.002))


def sheet_bracket():
    """An L of 80 x 60 x 40 mm of sheet 3 mm thick, a corner at the origin."""
    parts = [trimesh.creation.box(bounds=[[0, 0, 0], top]) for top in ([80, 3, 40], [3, 60, 40])]
    return trimesh.boolean.union(parts, engine="manifold").apply_scale(0.001)


def wedge():
    """A wedge 60 mm long and 50 mm wide, from 30 mm of height down to an edge, at the origin."""
    outline = [[0.0, 0.0], [0.06, -0.015], [0.06, 0.015]]
    corners = [(x, y, z) for y in (-0.025, 0.025) for x, z in outline]
    return trimesh.convex.convex_hull(np.array(corners))


SHARP_OBJECTS = {
    "box": box(),
    "plate": plate(),
    "sheet bracket": sheet_bracket(),
    "wedge": wedge(),
}


def face_normals_at(mesh, point, *, within):
    """Normals (F, 3) of all faces of a mesh that are so near to a point (3,)."""
    count = len(mesh.faces)
    nearest = trimesh.triangles.closest_point(mesh.triangles, np.tile(point, (count, 1)))
    near = np.linalg.norm(nearest - point, axis=1) <= within
    a, b, c = (mesh.triangles[near, corner] for corner in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
