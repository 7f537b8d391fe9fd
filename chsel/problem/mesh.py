"""Triangle meshes of objects: read, checked, merged, named by their content."""

from __future__ import annotations

import importlib.util
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import MeshError, MeshWarning, quoted, require_positive
from chsel.numerics.arrays import digest, frozen, refuse_special_file
from chsel.problem.mesh_parts import outer_surface

if TYPE_CHECKING:
    import trimesh

SMALLEST = 0.005  # metres; objects that a gripper probes have a larger extent
LARGEST = 10.0  # metres; a larger extent is probably in millimetres
TESSELLATION = 0.0001  # metres, see load_mesh
_SOLIDS = ("step", "stp")  # kinds of files in which surfaces are curved
_MILLIMETRES = 1000.0  # in a metre
_ACCEPTED = "accepted: a mesh in metres, such as .stl, .obj, .ply, .glb, .dae, .3mf, .step or .off"
_FAR = 3.0  # diameters from a mesh to the origin of its frame, up to which searches find poses
_NEAR = 0.5  # largest gap between the bodies of one object, in diameters of the largest body
_MOST_BODIES = 1000  # that are compared, the largest ones


def load_mesh(
    path: str | Path, *, scale: float = 1.0, tessellation: float = TESSELLATION
) -> trimesh.Trimesh:
    """Return the checked mesh in a file of any format that trimesh reads; scenes become one mesh.

    scale: metres per unit of the file; where the file states its unit (COLLADA, 3MF), of that unit
    in metres, with a warning if it is another one. Solids of STEP files, which state it too, are in
    metres times scale; tessellation: how far triangles may be from their surface, metres before
    scale. Checks and raises as `clean_mesh`, and MeshError if the file does not exist or cannot be
    read.
    """
    import trimesh

    path = Path(path).expanduser()
    refuse_special_file(f"mesh file {path}", path, error=MeshError)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise MeshError(f"mesh file {path} {what}; {_ACCEPTED}")
    kind = path.suffix.lower().removeprefix(".")
    options: dict[str, Any] = {}
    if kind in _SOLIDS:
        require_positive("mesh tessellation", tessellation)
        if importlib.util.find_spec("cascadio") is None:
            raise MeshError(
                f"mesh file {path} is read by cascadio, which is not installed; {_ACCEPTED}, or "
                "this one after pip install 'chsel-replay[files]'"
            )
        options = {"tol_linear": _MILLIMETRES * tessellation}
    if kind not in trimesh.available_formats():
        raise MeshError(f"mesh file {path} is of no kind that can be read; {_ACCEPTED}")
    if kind == "obj":
        _refuse_relative_indices(path)
    try:
        loaded = trimesh.load(
            str(path), file_type=kind, force="mesh", process=False, skip_materials=True, **options
        )
    except Exception as error:  # readers raise all kinds of errors on damaged files
        # An ImportError comes from guessing the encoding of a text that is not one.
        damaged = isinstance(error, ImportError) or (kind in _SOLIDS and path.is_file())
        reason = "it is damaged" if damaged else " ".join(str(error).split())
        if "unexpected length" in reason:
            reason = "it is cut short, or not all faces are triangles: export it with triangles"
        raise MeshError(
            f"mesh file {path} cannot be read as .{kind}: {reason}; {_ACCEPTED}"
        ) from error
    if not isinstance(loaded, trimesh.Trimesh):
        raise MeshError(f"mesh file {path} has no faces; accepted: triangle meshes")
    name = f"mesh file {path}"
    # Old versions of trimesh lose the unit of this format where they join its parts.
    units = loaded.units if kind != "3mf" else trimesh.load(str(path), process=False).units
    metres = _metres_of(units, name)
    if metres != 1.0:
        text = f"{name} states its unit, {metres:.6g} m, which scale multiplies"
        warnings.warn(MeshWarning("mesh_unit", text), stacklevel=2)
        name += f" (unit {metres:.6g} m, times scale)"
    hint = "pass chsel.load_mesh(path, scale=0.001), to commands object.scale=0.001"
    return clean_mesh(
        loaded.vertices, loaded.faces, name=name, scale=scale, metres=metres, hint=hint
    )


def _metres_of(unit: str | None, name: str) -> float:
    """Return metres of the unit that a file states; 1 if it states none."""
    import trimesh

    if unit is None:
        return 1.0
    try:
        metres = float(trimesh.units.unit_conversion(unit, "meters"))
    except (ValueError, KeyError):
        metres = 0.0
    if not 0.0 < metres < np.inf:
        raise MeshError(f"{name} states the unit {quoted(unit)}; accepted: a length, such as inch")
    return 1.0 if abs(metres - 1.0) < 1e-9 else metres


def _refuse_relative_indices(path: Path) -> None:
    """Raise MeshError for an OBJ file whose relative indices trimesh takes as from its end."""
    text = path.read_bytes()
    relative = re.search(rb"^[ \t]*f[ \t][^\n]*-\d", text, re.MULTILINE)
    if relative and re.search(rb"^[ \t]*v[ \t]", text[relative.start() :], re.MULTILINE):
        raise MeshError(
            f"mesh file {path} counts vertices back from faces (f -4 -3 -2) in several groups; "
            "accepted: indices that count from the first vertex of the file"
        )


def clean_mesh(
    vertices: Any,
    faces: Any,
    *,
    name: str = "mesh",
    scale: float = 1.0,
    metres: float = 1.0,
    hint: str = "multiply its vertices by 0.001",
) -> trimesh.Trimesh:
    """Return a checked mesh in metres: equal vertices merged, faces turned outward, float64.

    vertices (V, 3): in units of `scale` times `metres`. faces (F, 3): indices of vertices. hint:
    what to do about millimetres. Overlapping parts are united, see `outer_surface`. Warns about
    meshes that are open after merging, have parts that looked inward, or bodies far apart.
    Raises MeshError if there are no faces, a number is not finite, an index has no vertex, the mesh
    is flat, or its size in metres is not that of an object.
    """
    import trimesh

    require_positive("mesh scale", scale)
    vertices = frozen(f"{name}: vertices", vertices, shape=(None, 3), error=MeshError)
    faces = frozen(f"{name}: faces", faces, shape=(None, 3), dtype=np.int64, error=MeshError)
    if len(faces) == 0:
        raise MeshError(f"{name} has no faces; accepted: triangle meshes")
    outside = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise MeshError(
            f"{name}: faces[{row}] is {faces[row].tolist()}; "
            f"accepted: indices of its {len(vertices)} vertices"
        )
    scale *= metres
    _check_size(name, np.ptp(vertices[np.unique(faces)], axis=0) * scale, hint=hint)

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
    for warning in found + check_bodies(mesh, name) + check_frame(mesh, name):
        warnings.warn(warning, stacklevel=2)
    return mesh


def mesh_digest(mesh: trimesh.Trimesh) -> str:
    """Return digest of a mesh: of its vertices as float64 and its faces as int64."""
    return digest(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def check_bodies(mesh: trimesh.Trimesh, name: str) -> list[MeshWarning]:
    """Return a warning if bodies of a mesh (metres) are too far apart for a single object.

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


def check_frame(mesh: trimesh.Trimesh, name: str) -> list[MeshWarning]:
    """Return a warning if a mesh (metres) lies far from the origin of its frame."""
    away = float(np.sqrt((mesh.bounds.mean(axis=0) ** 2).sum()))
    diameter = float(np.sqrt((mesh.extents**2).sum()))
    if away <= _FAR * diameter:
        return []
    text = (
        f"{name} lies {away:.3g} m from the origin of its frame, and is {diameter:.3g} m large: "
        "searches look for that origin around the workspace, and may miss the pose; move the mesh "
        "to its origin"
    )
    return [MeshWarning("far_frame", text)]


def _check_size(name: str, extents: np.ndarray, *, hint: str) -> None:
    """Raise MeshError unless extents (3,), in metres, are those of a solid of plausible size."""
    largest = float(extents.max())
    size = " x ".join(f"{extent:.4g}" for extent in extents) + " m"
    accepted = f"accepted: a largest extent of {SMALLEST} m to {LARGEST:g} m"
    if largest > LARGEST:
        raise MeshError(
            f"{name} is {size}; if it is in millimetres, {hint} ({accepted} after scaling)"
        )
    if float(extents.min()) == 0.0:
        raise MeshError(f"{name} is {size}: flat; accepted: a solid, with three extents above 0")
    if largest < SMALLEST:
        larger = hint.replace("0.001", "S")
        raise MeshError(f"{name} is {size}: too small; {larger}, with a larger S ({accepted})")
