"""The attachments of a recording: the object's mesh and its SDF grid."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from chsel.errors import RecordingError
from chsel.problem.mesh import mesh_digest
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.sdf_grid import SdfGrid
from replay.mcap.encoding import decode, encode, shared_values
from replay.mcap.schemas import MESH, SDF_GRID
from replay.mcap.validation import check_digest, check_mesh

if TYPE_CHECKING:
    import trimesh

MEDIA_TYPES = {MESH: "model/ply", SDF_GRID: "application/protobuf; message=chsel.SdfGrid"}

_VERTEX = np.dtype(("<f8", 3))
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
_HEADER = """\
ply
format binary_little_endian 1.0
comment metres
element vertex {vertices}
property double x
property double y
property double z
element face {faces}
property list uchar int vertex_indices
end_header
"""
_HEADER_PATTERN = _HEADER.replace("{vertices}", r"(\d{1,9})").replace("{faces}", r"(\d{1,9})")
_LONGEST_HEADER = len(_HEADER) + 20


def mesh_to_ply(mesh: trimesh.Trimesh) -> bytes:
    """Return vertices and faces of a mesh as a PLY file with float64 coordinates; exact."""
    vertices = np.ascontiguousarray(mesh.vertices, "<f8")
    check_mesh(vertices, mesh.faces)
    faces = np.zeros(len(mesh.faces), _FACE)
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    header = _HEADER.format(vertices=len(vertices), faces=len(faces))
    return header.encode() + vertices.tobytes() + faces.tobytes()


def mesh_from_ply(data: bytes) -> trimesh.Trimesh:
    """Return the mesh that `mesh_to_ply` wrote; raise RecordingError for any other file."""
    import trimesh

    header = re.match(_HEADER_PATTERN.encode(), data[:_LONGEST_HEADER])
    if header is None:
        raise RecordingError(f"attachment {MESH} has no header as written by this project")
    vertex_count, face_count = int(header[1]), int(header[2])
    split = header.end() + vertex_count * _VERTEX.itemsize
    if len(data) != split + face_count * _FACE.itemsize:
        raise RecordingError(f"attachment {MESH} is not as long as its header says")
    vertices = np.frombuffer(data, "<f8", vertex_count * 3, header.end()).reshape(-1, 3)
    faces = np.frombuffer(data, _FACE, face_count, split)
    indices = faces["vertices"].astype(np.int64)
    if (faces["count"] != 3).any():
        raise RecordingError(f"attachment {MESH} has a face that is no triangle")
    check_mesh(vertices, indices)
    return trimesh.Trimesh(vertices.astype(np.float64), indices, process=False)


def mesh_attached(attachments: Mapping[str, bytes], digest: str) -> trimesh.Trimesh:
    """Return the mesh among attachments; raise RecordingError unless it has the digest."""
    mesh = mesh_from_ply(_data(attachments, MESH))
    check_digest(f"attachment {MESH}", mesh_digest(mesh), recorded=digest)
    return mesh


def sdf_attached(attachments: Mapping[str, bytes], digest: str) -> SdfGrid:
    """Return the SDF grid among attachments, likewise."""
    values = decode("SdfGrid", _data(attachments, SDF_GRID))
    declared = values["symmetry"]
    symmetry = None if declared is None else ObjectSymmetry(**declared)
    sdf = SdfGrid(**{**values, "symmetry": symmetry})
    check_digest(f"attachment {SDF_GRID}", sdf.digest, recorded=digest)
    return sdf


def _data(attachments: Mapping[str, bytes], name: str) -> bytes:
    if name not in attachments:
        raise RecordingError(f"it lacks the attachment {name}")
    return attachments[name]


def sdf_to_bytes(sdf: SdfGrid) -> bytes:
    """Return a grid as a protobuf message; exact."""
    symmetry = None if sdf.symmetry is None else shared_values("Symmetry", sdf.symmetry)
    return encode("SdfGrid", {**shared_values("SdfGrid", sdf), "symmetry": symmetry})
