"""What a registration uses where its caller chooses nothing: the same for commands and programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from chsel.problem.mesh import mesh_digest
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import DEFAULT_NODES, OBJECT_PADDING, SdfGrid

if TYPE_CHECKING:
    import trimesh

FREE_RESOLUTION = 0.01  # side of a voxel of free space, metres
_MOST_KEPT = 4  # grids
_kept: dict[tuple[str, float | None, float], SdfGrid] = {}  # those made last, in this order


def object_grid(
    mesh: trimesh.Trimesh,
    resolution: float | None = None,
    *,
    padding: float = OBJECT_PADDING,
    progress: Callable[[int, int], None] | None = None,
) -> SdfGrid:
    """The grid of a clean mesh by `SdfGrid.from_mesh`, kept for later calls with this mesh."""
    key = mesh_digest(mesh), resolution, padding
    grid = _kept.get(key)
    if grid is None:
        grid = SdfGrid.from_mesh(mesh, resolution, padding=padding, progress=progress)
        if grid.values.size <= DEFAULT_NODES:
            _kept[key] = grid
        for oldest in list(_kept)[:-_MOST_KEPT]:
            _kept.pop(oldest, None)
    return grid


def workspace_around(points: KnownPoints, sdf: SdfGrid) -> Workspace:
    """Where an object can be that touches some of the points: their bounds and its diameter."""
    return Workspace.around(points.all_points(), sdf.diameter)
