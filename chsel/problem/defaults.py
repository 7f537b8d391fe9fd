"""What a registration uses where its caller chooses nothing: the same for commands and programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid

if TYPE_CHECKING:
    import trimesh

FREE_RESOLUTION = 0.01  # side of a voxel of free space, metres
OBJECT_PADDING = 0.05  # of the SDF grid around the object, metres
_NODES_PER_EXTENT = 20  # of the SDF grid, over the object's smallest extent
_COARSEST = 0.01  # spacing of these nodes, metres


def object_grid(
    mesh: trimesh.Trimesh,
    resolution: float | None = None,
    *,
    padding: float = OBJECT_PADDING,
    progress: Callable[[int, int], None] | None = None,
) -> SdfGrid:
    """The signed distance grid of a clean mesh, metres, see `SdfGrid.from_mesh`.

    resolution: metres; None: a twentieth of the object's smallest extent, at most 1 cm.
    """
    if resolution is None:
        resolution = min(_COARSEST, float(np.min(mesh.extents)) / _NODES_PER_EXTENT)
    return SdfGrid.from_mesh(mesh, resolution, padding=padding, progress=progress)


def workspace_around(points: KnownPoints, sdf: SdfGrid) -> Workspace:
    """Where an object can be that touches some of the points: their bounds and its diameter."""
    return Workspace.around(points.all_points(), sdf.diameter)
