"""The collision shapes of a URDF as closed solids in their links' frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import SettingError

if TYPE_CHECKING:
    import trimesh


MOST_BYTES = 32 * 2**20  # of the mesh files of one URDF together
_MOST_LISTED = 5
_SUFFIXES = (".stl", ".obj", ".ply", ".off")


class MeshFiles:
    """Reads the mesh files of a URDF, each once.

    urdf: its path, beside which relative paths are looked for. warnings: of meshes that were not
    closed, and are their convex hulls here.
    """

    def __init__(self, urdf: Path) -> None:
        self._folder = urdf.resolve().parent
        self._read: dict[Path, trimesh.Trimesh] = {}
        self._bytes = 0
        self.warnings: list[str] = []

    def solid(self, name: str | None, scale: Any, where: str) -> trimesh.Trimesh:
        """The closed solid in the file `name`, times `scale`: None, a number, or three (3,).

        where: names the link in messages. Raises SettingError if there is no such solid.
        """
        if not name:
            raise SettingError(f"{where}: mesh without a filename")
        path = self._found(name, where)
        if path not in self._read:
            self._read[path] = self._loaded(path, where)
        factors = np.ones(1) if scale is None else np.asarray(scale, float).reshape(-1)
        if len(factors) not in (1, 3) or not np.isfinite(factors).all() or (factors == 0.0).any():
            raise SettingError(
                f"{where}: scale of {name} is {factors.tolist()}; accepted: one number or three, "
                "finite, not 0"
            )
        return (
            self._read[path].copy().apply_transform(np.diag([*np.broadcast_to(factors, (3,)), 1.0]))
        )

    def _found(self, name: str, where: str) -> Path:
        tried = list(dict.fromkeys(self._candidates(name)))
        for path in tried:
            if _is_file(path):
                return path
        places = ", ".join(map(str, tried[:_MOST_LISTED])) or "nowhere"
        raise SettingError(f"{where}: mesh {name} does not exist; looked for {places}")

    def _candidates(self, name: str) -> list[Path]:
        """Where a file may be; a package is one of the folders above the URDF, or in one."""
        scheme, _, rest = name.partition("://")
        if not rest:
            return [self._folder / name]
        if scheme == "file":
            return [Path(rest)]
        if scheme not in ("package", "model"):
            return []
        within = PurePosixPath(*PurePosixPath(rest).parts[1:])
        return [
            folder / part
            for folder in (self._folder, *self._folder.parents)
            for part in (within, rest)
        ]

    def _loaded(self, path: Path, where: str) -> trimesh.Trimesh:
        import trimesh

        where = f"{where}: mesh {path}"
        if path.suffix.lower() not in _SUFFIXES:
            raise SettingError(f"{where} is of no known kind; accepted: {', '.join(_SUFFIXES)}")
        self._bytes += path.stat().st_size
        if self._bytes > MOST_BYTES:
            raise SettingError(
                f"{where} makes the meshes more than {MOST_BYTES} bytes; accepted: fewer"
            )
        try:
            loaded: Any = trimesh.load(
                str(path), force="mesh", process=False, skip_materials=True, ignore_broken=True
            )
            mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
            whole = len(mesh.faces) > 0 and bool(np.isfinite(mesh.vertices).all())
        except Exception as error:  # readers of damaged files raise whatever they stumble over
            reason = " ".join(str(error).split())[:200]
            raise SettingError(f"{where} cannot be read: {reason}") from None
        if not whole:
            raise SettingError(f"{where} has no faces, or corners that are not finite")
        mesh.merge_vertices()
        return self._closed(where, mesh)

    def _closed(self, where: str, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """The mesh, turned outward; its convex hull if it is open."""
        if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume != 0.0):
            try:
                mesh = mesh.convex_hull
            except Exception:  # of qhull, for flat meshes
                raise SettingError(f"{where} is flat; accepted: a solid") from None
            self.warnings.append(f"{where} is open; its convex hull is used")
        if mesh.volume < 0.0:
            mesh.invert()
        return mesh


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


_CYLINDER_SIDES = 32  # the prism lies within the cylinder, so it claims no free space too much


def collision_solid(collision: Any, files: MeshFiles, where: str) -> trimesh.Trimesh:
    """The solid of a Collision of yourdfpy; `where` names its link in messages.

    Raises SettingError for sizes that are not above 0, and a mesh that cannot be used.
    """
    solid = _solid(collision.geometry, files, where)
    if collision.origin is None:
        return solid
    if not np.isfinite(collision.origin).all():
        raise SettingError(f"{where}: origin of a collision shape is not finite")
    return solid.apply_transform(collision.origin)


def _solid(geometry: Any, files: MeshFiles, where: str) -> trimesh.Trimesh:
    import trimesh

    if geometry.box is not None:
        return trimesh.creation.box(_sizes("box", geometry.box.size, 3, where))
    if geometry.sphere is not None:
        (radius,) = _sizes("sphere", [geometry.sphere.radius], 1, where)
        return trimesh.creation.icosphere(subdivisions=2, radius=radius)
    if geometry.cylinder is not None:
        sizes = [geometry.cylinder.radius, geometry.cylinder.length]
        radius, length = _sizes("cylinder", sizes, 2, where)
        return trimesh.creation.cylinder(radius, length, sections=_CYLINDER_SIDES)
    return files.solid(geometry.mesh.filename, geometry.mesh.scale, where)


def _sizes(kind: str, sizes: Sequence[float], count: int, where: str) -> list[float]:
    values = np.asarray(sizes, dtype=float)
    if values.shape != (count,) or not np.isfinite(values).all() or not (values > 0.0).all():
        raise SettingError(
            f"{where}: size of a {kind} is {values.tolist()[:count]}; accepted: finite, above 0, "
            f"{count} in number"
        )
    return values.tolist()
