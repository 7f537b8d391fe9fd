"""One call from points to hypotheses, for programs that need no session and no files."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import MeshError, PointsError, PointsWarning, quoted, require_instance
from chsel.methods import build_method, default_method, noise_of, preset_settings, trust_by
from chsel.numerics.arrays import frozen
from chsel.problem.mesh import clean_mesh
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.points import (
    FREE_RESOLUTION,
    KnownPoints,
    Workspace,
    check_contacts,
    check_points,
    require_parts,
    workspace_around,
)
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, Observer
from chsel.problem.sdf_grid import SdfGrid, object_grid
from chsel.problem.settings import changed_settings
from chsel.problem.trust import check_trust

if TYPE_CHECKING:
    import trimesh


def register(
    target: trimesh.Trimesh | SdfGrid,
    *,
    surface: Any = None,
    free: Any = None,
    occupied: Any = None,
    known: Any = None,
    known_sdf: Any = None,
    method: str | None = None,
    preset: str = "default",
    settings: Any = None,
    hypotheses: int | None = None,
    workspace: Workspace | None = None,
    initial_set: Any = None,
    pushes: Pushes | None = None,
    previous: Hypotheses | None = None,
    resolution: float | None = None,
    free_resolution: float = FREE_RESOLUTION,
    seed: int = 0,
    step: int = 0,
    observer: Observer | None = None,
) -> Hypotheses:
    """Plausible poses of an object from what is known of points in the world.

    target: the object's mesh in metres, or its signed distance grid. surface (M, 3), free (N, 3),
    occupied (K, 3): points on, outside and inside of the object. known (L, 3), known_sdf (L,):
    points of known signed distance, metres. Numpy arrays, torch tensors or lists.
    method, preset: see chsel.methods; by default `anchored`, and in the presets paper and reference
    `chsel`, their method. settings: a mapping of single settings over the preset's, such as
    {"size": "large"}, or a whole settings object.
    hypotheses: B, 30 by default. workspace: where the object can be; by default the bounds of the
    points padded by the object's diameter. initial_set (B, 4, 4): E_0 as object_from_world.
    pushes: that may have moved the object while points became known, counted as free, occupied and
    known, of which surface comes first; `anchored` finds where it is now.
    previous: the last result, when points were added since (CHSEL, Alg. 2). resolution: of the
    SDF grid of a mesh, metres; by default that of `SdfGrid.from_mesh`. The grid is kept for the
    next call with this mesh. free_resolution: voxel side of free space, metres; used by free_term
    interior. seed, step: of the random streams.

    Returns hypotheses with costs, best first, repeated poses flagged, and with `trust`: how far to
    trust them, see `trust_in`; None if an installed method finds no pose.
    Raises ChselError, with what is accepted, for malformed input; at least one point is needed.
    Warns with PointsWarning about points that are hardly meant, and where no hypothesis explains
    them, see chsel.problem.points and chsel.problem.trust.
    """
    points = _known_points(surface, free, occupied, known, known_sdf)
    if workspace is not None:
        require_parts(workspace=workspace)
    if previous is not None:
        what = "the Hypotheses of the registration before, or None"
        require_instance("previous", previous, Hypotheses, what)
    method = default_method(preset) if method is None else method
    more = None if hypotheses is None else {"online": {"hypotheses": hypotheses}}
    solver = build_method(method, method_settings(method, preset, settings, more))
    sdf = _grid(target, resolution)
    _warn(check_points(points, sdf.diameter, free_resolution, workspace) + check_contacts(points))
    workspace = workspace or workspace_around(points, sdf)
    online = OnlineRegistration(
        sdf,
        workspace,
        free_resolution,
        solver.online,
        seed=seed,
        points=points,
        previous=previous,
    )
    problem = online.pose(step)
    if initial_set is not None:
        problem = replace(problem, initial_set=initial_set)
    if pushes is not None:
        what = "chsel.Pushes(directions, before, largest)"
        require_instance("pushes", pushes, Pushes, what)
        problem = replace(problem, pushes=pushes)
    result = solver.register(problem, observer)
    trust = trust_by(solver, problem, result)
    if trust is not None:
        _warn(check_trust(trust, noise_of(solver)))
    return replace(result, trust=trust)


def _warn(points_warnings: list[PointsWarning]) -> None:
    """Warn at the line that calls `register`."""
    for warning in points_warnings:
        warnings.warn(warning, stacklevel=3)


def _known_points(surface: Any, free: Any, occupied: Any, known: Any, sdf: Any) -> KnownPoints:
    """All classes together; None stands for no points."""
    none = np.zeros((0, 3))
    surface, free, occupied, known = (
        none if points is None else points for points in (surface, free, occupied, known)
    )
    others = KnownPoints(free, occupied, known, np.zeros(0) if sdf is None else sdf)
    points = KnownPoints(known=frozen("surface", surface, (None, 3))).merged(others)
    if points.count == 0:
        raise PointsError("no point was given; accepted: surface, free, occupied or known points")
    return points


def _grid(target: trimesh.Trimesh | SdfGrid, resolution: float | None) -> SdfGrid:
    if isinstance(target, SdfGrid):
        return target
    import trimesh  # which takes longer to import than a registration

    if not isinstance(target, trimesh.Trimesh):
        path = target if isinstance(target, str | Path) else "mesh.obj"
        shown = quoted(target) if isinstance(target, str | Path) else f"a {type(target).__name__}"
        raise MeshError(
            f"target is {shown}; accepted: a mesh such as chsel.load_mesh({str(path)!r}), "
            "a Trimesh, or a SdfGrid"
        )
    return object_grid(clean_mesh(target.vertices, target.faces, name="target"), resolution)


def method_settings(method: str, preset: str, *changes: Any) -> Any:
    """The preset's settings with changes laid over them: mappings, or whole settings objects."""
    chosen = preset_settings(method, preset)
    for change in changes:
        if dataclasses.is_dataclass(change) and not isinstance(change, type):
            chosen = change
        elif change is not None:
            require_instance(
                "settings", change, Mapping, "a mapping, or the settings of the method"
            )
            chosen = changed_settings(chosen, change, f"method={method}: settings")
    return chosen
