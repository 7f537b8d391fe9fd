"""The problems of the benchmark: a drill among free points on a lattice, touched in some places."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings, first_initial_set
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from chsel.problem.streams import StreamKey
from runners.objects.loader import ObjectConfig, load_object

WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.3, 0.625))  # of the simulated sessions
_SDF_RESOLUTION = 0.01
_YAW = 0.5


@dataclass(frozen=True)
class Problem:
    """One problem, still to be made."""

    scale: float = 1.0  # of the drill; 1 is its real size, 2.5 that of the simulator
    contacts: int = 20  # points on its surface
    free_points: int = 20_000  # about how many there are
    hypotheses: int = 30  # B
    long: bool = False  # the longer search


PROBLEMS = {
    f"{size}_{contacts}": Problem(scale, contacts)
    for size, scale in (("real", 1.0), ("large", 2.5))
    for contacts in (5, 20, 150)
} | {"real_20_long": Problem(long=True)}


def pose(problem: Problem, seed: int) -> RegistrationProblem:
    """Make a problem; all that is random in it follows from `seed`."""
    mesh, sdf = drill(problem.scale)
    world_from_object = standing(mesh)
    volume = float(np.prod(np.subtract(WORKSPACE.upper, WORKSPACE.lower)) - mesh.volume)
    spacing = round(float(np.cbrt(volume / problem.free_points)), 4)  # whole tenths of a millimetre
    surface = trimesh.sample.sample_surface(mesh, problem.contacts, seed=seed)[0]
    contacts = apply(world_from_object, np.asarray(surface, dtype=np.float64))
    points = KnownPoints(free=_outside(mesh, world_from_object, spacing), known=contacts)
    settings = OnlineSettings(hypotheses=problem.hypotheses)
    initial_set = first_initial_set(WORKSPACE, points, StreamKey(seed, 0), settings)
    return RegistrationProblem(sdf, points, initial_set, WORKSPACE, spacing, StreamKey(0, 0))


@lru_cache
def drill(scale: float) -> tuple[trimesh.Trimesh, SdfGrid]:
    """The mesh of the model, and its signed distance grid."""
    mesh = load_object(ObjectConfig("drill", scale, 0.001, "drill"), Path()).mesh
    return mesh, SdfGrid.from_mesh(mesh, _SDF_RESOLUTION)


def standing(mesh: trimesh.Trimesh) -> FloatArray:
    """world_from_object (4, 4): turned, on the floor in the middle of the workspace."""
    lower, upper = np.asarray(mesh.bounds)
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(_YAW))
    foot = np.array([*(lower + upper)[:2] / 2.0, lower[2]])
    middle = np.array([*WORKSPACE.bounds.mean(axis=0)[:2], 0.0])
    return compose(turn, middle - turn @ foot)


def _outside(mesh: trimesh.Trimesh, world_from_object: FloatArray, spacing: float) -> FloatArray:
    """The points (N, 3) of a lattice in the workspace that are outside of the object."""
    # At whole multiples of the spacing, where the published package has its voxels, too.
    lower, upper = WORKSPACE.bounds
    first, last = np.ceil(lower / spacing), np.floor(upper / spacing)
    steps = np.indices((last - first).astype(int) + 1).reshape(3, -1).T
    points = (first + steps) * spacing
    signed, _ = mesh_sdf(mesh, apply(inverse(world_from_object), points))
    return points[signed > 0.0]
