"""One call from points to hypotheses, for programs that need no session and no files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chsel.errors import (
    MeshError,
    PointsError,
    PointsWarning,
    quoted,
    require_instance,
    require_metres,
)
from chsel.methods import MOST_NOISE, build_method, default_method, method_settings
from chsel.problem.initial_sets import posed_problem
from chsel.problem.mesh import clean_mesh
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.points import (
    FREE_RESOLUTION,
    KnownPoints,
    Workspace,
    check_contacts,
    check_places,
    check_points,
    check_workspace,
    distinct_points,
    require_parts,
    same_place,
    workspace_around,
)
from chsel.problem.pose_distances import with_symmetry
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import inverse
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, Observer, check_prior
from chsel.problem.sdf_grid import SdfGrid, object_grid
from chsel.problem.streams import StreamKey
from chsel.problem.trust import check_trust
from chsel.session.judging import check_normals, noise_of, trust_by
from chsel.session.perception import known_points, refuse_surface

if TYPE_CHECKING:
    import trimesh


def register(
    target: trimesh.Trimesh | SdfGrid,
    *unnamed: Any,
    contacts: Any = None,
    normals: Any = None,
    normal_noise: Any = None,
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
    prior: PosePrior | None = None,
    symmetry: ObjectSymmetry | None = None,
    previous: Hypotheses | None = None,
    resolution: float | None = None,
    free_resolution: float = FREE_RESOLUTION,
    seed: int = 0,
    step: int = 0,
    observer: Observer | None = None,
) -> Hypotheses:
    """Plausible poses of an object from what is known of points in the world.

    target: the object's mesh in metres, or its signed distance grid. contacts (M, 3), free (N, 3),
    occupied (K, 3): points on, outside and inside of the object. known (L, 3), known_sdf (L,):
    points of known signed distance, metres. Numpy arrays, torch tensors or lists. A place on the
    object that is measured again counts once. surface: refused, the former name of contacts.
    normals (M, 3): unit vectors of the contacts out of the object, world; (0, 0, 0) where one is
    not known. normal_noise: root mean square angle by which they are off, radians, one number or
    (M,); by default 0.25.
    method, preset: see chsel.methods; by default `anchored`, and in the presets paper and reference
    `chsel`, their method. settings: a mapping of single settings over the preset's, such as
    {"size": "large"}, or a whole settings object.
    hypotheses: B, 30 by default. workspace: where the object can be; by default the bounds of the
    points padded by the object's diameter. initial_set (B, 4, 4): E_0 as object_from_world.
    pushes: that may have moved the object while points became known, counted as free, occupied and
    known, of which contacts come first; `anchored` finds where it is now.
    prior: what is known of the pose beforehand, before any push; read by `anchored` and by trust.
    symmetry: turns after which the object counts as the same, by which verdict and modes go; by
    default those that map its surface to itself.
    previous: the last result, when points were added since (CHSEL, Alg. 2). resolution: of the
    SDF grid of a mesh, metres; by default that of `SdfGrid.from_mesh`. The grid is kept for the
    next call with this mesh. free_resolution: voxel side of free space, metres; used by free_term
    interior. seed, step: of the random streams.

    Returns hypotheses with costs, best first, repeated poses flagged, and with `trust`: how far to
    trust them, see `trust_in`; None if an installed method finds no pose.
    Raises ChselError, with what is accepted, for malformed input; at least one point is needed.
    Warns with PointsWarning about suspicious points, and where no hypothesis explains them, see
    chsel.problem.points and chsel.problem.trust.
    """
    if unnamed:
        raise PointsError("points have no name; accepted: chsel.register(mesh, contacts=points)")
    refuse_surface(surface)
    given = known_points(
        contacts=contacts,
        normals=normals,
        normal_noise=normal_noise,
        free=free,
        occupied=occupied,
        known=known,
        known_sdf=known_sdf,
    )
    if given.count == 0:
        raise PointsError("no point was given; accepted: contacts, free, occupied or known points")
    if workspace is not None:
        require_parts(workspace=workspace)
    if previous is not None:
        what = "the Hypotheses of the registration before, or None"
        require_instance("previous", previous, kind=Hypotheses, accepted=what)
    method = default_method(preset) if method is None else method
    more = None if hypotheses is None else {"online": {"hypotheses": hypotheses}}
    solver = build_method(method, method_settings(method, preset, settings, more))
    sdf = with_symmetry(_grid(target, resolution), symmetry)
    require_metres("noise", noise_of(solver), most=MOST_NOISE * sdf.diameter, diameter=sdf.diameter)
    points, repeated = distinct_points(given, KnownPoints(), apart=same_place(sdf.diameter))
    if pushes is not None:  # which count the points
        points, repeated = given, []
    _warn(
        check_points(points, sdf.diameter, free_resolution=free_resolution, workspace=workspace)
        + check_contacts(points)
    )
    _warn(
        repeated
        + check_places("the nearest known point", points.all_points(), diameter=sdf.diameter)
    )
    if workspace is not None:
        _warn(check_workspace(workspace, sdf.diameter))
    workspace = workspace or workspace_around(points, sdf)
    problem = posed_problem(
        sdf,
        points,
        workspace=workspace,
        free_resolution=free_resolution,
        key=StreamKey(seed, step),
        settings=solver.online,
        previous=previous,
        prior=prior,
    )
    if initial_set is not None:
        problem = replace(problem, initial_set=initial_set)
        places = inverse(problem.initial_set)[:, :3, 3]
        _warn(check_places("initial_set", places, diameter=sdf.diameter, workspace=workspace))
    if pushes is not None:
        what = "chsel.Pushes(directions, before, largest)"
        require_instance("pushes", pushes, kind=Pushes, accepted=what)
        problem = replace(problem, pushes=pushes)
    result = solver.register(problem, observer)
    trust = trust_by(solver, problem, hypotheses=result)
    if trust is not None:
        _warn(check_trust(trust, noise_of(solver)) + check_prior(problem, result))
        _warn(check_normals(solver, problem, hypotheses=result))
    return replace(result, trust=trust)


def _warn(points_warnings: list[PointsWarning]) -> None:
    """Warn at the line that calls `register`."""
    for warning in points_warnings:
        warnings.warn(warning, stacklevel=3)


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
