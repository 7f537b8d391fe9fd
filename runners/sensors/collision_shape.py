"""One collision shape of a URDF as a closed solid in its link's frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import SettingError
from runners.sensors.collision_mesh import MeshFiles

if TYPE_CHECKING:
    import trimesh

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
