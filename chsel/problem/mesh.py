"""Triangle meshes of objects: read, checked, merged, named by their content."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import MeshError, MeshWarning, require_positive
from chsel.numerics.arrays import digest, frozen, refuse_special_file
from chsel.problem.mesh_parts import outer_surface

if TYPE_CHECKING:
    import trimesh

SMALLEST = 0.005  # metres; objects that a gripper probes have a larger extent
LARGEST = 10.0  # metres; a larger extent is probably in millimetres
_NEAR = 0.5  # largest gap between the bodies of one object, in diameters of the largest body
_MOST_BODIES = 1000  # that are compared, the largest ones


def load_mesh(path: str | Path, *, scale: float = 1.0) -> trimesh.Trimesh:
    """The checked mesh in a file of any format that trimesh reads; scenes become one mesh.

    scale: metres per unit of the file. Checks and raises as `clean_mesh`, and MeshError if the file
    does not exist or cannot be read.
    """
    import trimesh

    path = Path(path).expanduser()
    refuse_special_file(f"mesh file {path}", path, MeshError)
    accepted = "a mesh in metres as ." + ", .".join(sorted(trimesh.available_formats()))
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise MeshError(f"mesh file {path} {what}; accepted: {accepted}")
    kind = path.suffix.lower().removeprefix(".")
    try:
        loaded = trimesh.load(
            str(path), file_type=kind, force="mesh", process=False, skip_materials=True
        )
    except Exception as error:  # readers raise all kinds of errors on damaged files
        # An ImportError comes from guessing the encoding of a text that is not one.
        damaged = isinstance(error, ImportError)
        reason = "it is damaged" if damaged else " ".join(str(error).split())
        raise MeshError(
            f"mesh file {path} cannot be read as .{kind}: {reason}; accepted: {accepted}"
        ) from error
    if not isinstance(loaded, trimesh.Trimesh):
        raise MeshError(f"mesh file {path} has no faces; accepted: triangle meshes")
    return clean_mesh(loaded.vertices, loaded.faces, name=f"mesh file {path}", scale=scale)


def clean_mesh(
    vertices: Any, faces: Any, *, name: str = "mesh", scale: float = 1.0
) -> trimesh.Trimesh:
    """A checked mesh in metres: equal vertices merged, faces turned outward, float64.

    vertices (V, 3): in units of `scale` metres. faces (F, 3): indices of vertices. Warns about
    meshes that are open after merging, or have bodies far apart.
    Raises MeshError if there are no faces, a number is not finite, an index has no vertex, the mesh
    is flat, or its size in metres is not that of an object.
    """
    import trimesh

    require_positive("mesh scale", scale)
    vertices = frozen(f"{name}: vertices", vertices, (None, 3), error=MeshError)
    faces = frozen(f"{name}: faces", faces, (None, 3), dtype=np.int64, error=MeshError)
    if len(faces) == 0:
        raise MeshError(f"{name} has no faces; accepted: triangle meshes")
    outside = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise MeshError(
            f"{name}: faces[{row}] is {faces[row].tolist()}; "
            f"accepted: indices of its {len(vertices)} vertices"
        )
    _check_size(name, np.ptp(vertices[np.unique(faces)], axis=0) * scale)

    # Without textures and normals, whose seams would keep vertices apart.
    mesh = trimesh.Trimesh(vertices * scale, faces, process=False)
    mesh.merge_vertices()
    a, b, c = mesh.faces.T
    mesh.update_faces((a != b) & (b != c) & (c != a))  # merging may collapse faces
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise MeshError(f"{name} has no face with an area; accepted: triangle meshes")
    mesh, found = outer_surface(mesh, name)
    if not mesh.is_watertight:
        text = (
            f"{name} is open even after merging its vertices: the sign near holes is inexact, "
            "distances are those to the surface"
        )
        found.append(MeshWarning("open_mesh", text))
    for warning in found + check_bodies(mesh, name):
        warnings.warn(warning, stacklevel=2)
    return mesh


def mesh_digest(mesh: trimesh.Trimesh) -> str:
    """Digest of a mesh: of its vertices as float64 and its faces as int64."""
    return digest(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def check_bodies(mesh: trimesh.Trimesh, name: str) -> list[MeshWarning]:
    """A warning if bodies of a mesh (metres) are too far apart for a single object.

    The distance between two bodies is that of the boxes around them; near bodies count as one.
    """
    import trimesh
    from scipy.sparse.csgraph import connected_components

    body = trimesh.graph.connected_component_labels(mesh.edges, len(mesh.vertices))
    lower, upper = np.full((2, body.max() + 1, 3), [[[np.inf]], [[-np.inf]]])
    np.minimum.at(lower, body, mesh.vertices)
    np.maximum.at(upper, body, mesh.vertices)
    largest_first = np.argsort(-((upper - lower) ** 2).sum(axis=1), kind="stable")[:_MOST_BODIES]
    lower, upper = lower[largest_first], upper[largest_first]
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


def _check_size(name: str, extents: np.ndarray) -> None:
    """Raise MeshError unless extents (3,), in metres, are those of a solid of plausible size."""
    largest = float(extents.max())
    size = " x ".join(f"{extent:.4g}" for extent in extents) + " m"
    accepted = f"accepted: a largest extent of {SMALLEST} m to {LARGEST:g} m"
    if largest > LARGEST:
        raise MeshError(
            f"{name} is {size}; looks like millimetres; pass scale=0.001, to commands "
            f"object.scale=0.001 ({accepted} after scaling)"
        )
    if float(extents.min()) == 0.0:
        raise MeshError(f"{name} is {size}: flat; accepted: a solid, with three extents above 0")
    if largest < SMALLEST:
        raise MeshError(f"{name} is {size}: too small; pass a larger scale ({accepted})")
