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
from runners.published_package.problem_file import save_problem

SDF_RESOLUTION = 0.01
FREE_POINTS = 20_000
WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.3, 0.625))  # of the simulated sessions
_YAW = 0.5


@dataclass(frozen=True)
class Problem:
    """One problem, still to be made."""

    scale: float = 1.0  # of the drill; 1 is its real size, 2.5 that of the simulator
    contacts: int = 20  # points on its surface
    free_points: int = FREE_POINTS  # about how many there are
    hypotheses: int = 30  # B
    long: bool = False  # the longer search
    spread: bool = False
    """Free points fill a box as large as their number needs at the usual spacing, instead of the
    workspace as densely as they must."""


_SIZES = {"real": 1.0, "large": 2.5}
PROBLEMS = {
    f"{size}_{contacts}": Problem(scale, contacts)
    for size, scale in _SIZES.items()
    for contacts in (5, 20, 150)
} | {"real_20_long": Problem(long=True)}


@dataclass(frozen=True, eq=False)
class PosedProblem:
    """The arrays of a problem, from which either package starts."""

    sdf: SdfGrid
    free: FloatArray  # (N, 3), world, metres
    contacts: FloatArray  # (M, 3), world, metres
    free_spacing: float  # of the lattice, metres
    initial_set: FloatArray  # E_0 (B, 4, 4), object_from_world
    workspace: Workspace  # what the free points fill
    object_bounds: FloatArray  # (2, 3), of the mesh, in its frame, metres
    world_from_object: FloatArray  # (4, 4), the truth

    def registration_problem(self) -> RegistrationProblem:
        """The same as this library takes it."""
        return RegistrationProblem(
            self.sdf,
            KnownPoints(free=self.free, known=self.contacts),
            self.initial_set,
            self.workspace,
            self.free_spacing,
            StreamKey(0, 0),
        )

    def description(self) -> dict[str, object]:
        """Its numbers, for the report."""
        return {
            "free_points": len(self.free),
            "free_spacing": self.free_spacing,
            "contacts": len(self.contacts),
            "hypotheses": len(self.initial_set),
            "workspace": self.workspace.bounds.tolist(),
            "sdf_resolution": self.sdf.resolution,
            "sdf_nodes": list(self.sdf.shape),
            "world_from_object": self.world_from_object.tolist(),
        }

    def save(self, path: Path) -> None:
        """Write the problem for another process."""
        save_problem(self.registration_problem(), self.object_bounds, path)


def pose(problem: Problem, seed: int) -> PosedProblem:
    """Make a problem; all that is random in it follows from `seed`."""
    mesh, sdf = drill(problem.scale)
    world_from_object = _standing(mesh)
    box, spacing = _lattice(problem, mesh, world_from_object)
    free = _outside(mesh, world_from_object, box, spacing)
    surface = trimesh.sample.sample_surface(mesh, problem.contacts, seed=seed)[0]
    contacts = apply(world_from_object, np.asarray(surface, dtype=np.float64))
    points = KnownPoints(free=free, known=contacts)
    settings = OnlineSettings(hypotheses=problem.hypotheses)
    initial_set = first_initial_set(box, points, StreamKey(seed, 0), settings)
    bounds = np.asarray(mesh.bounds, dtype=np.float64)
    return PosedProblem(sdf, free, contacts, spacing, initial_set, box, bounds, world_from_object)


@lru_cache
def drill(scale: float) -> tuple[trimesh.Trimesh, SdfGrid]:
    """The mesh of the model, and its signed distance grid."""
    mesh = load_object(ObjectConfig("drill", scale, 0.001, "drill"), Path()).mesh
    return mesh, SdfGrid.from_mesh(mesh, SDF_RESOLUTION)


def _standing(mesh: trimesh.Trimesh) -> FloatArray:
    """world_from_object (4, 4): turned, on the floor in the middle of the workspace."""
    lower, upper = np.asarray(mesh.bounds)
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(_YAW))
    foot = np.array([*(lower + upper)[:2] / 2.0, lower[2]])
    middle = np.array([*WORKSPACE.bounds.mean(axis=0)[:2], 0.0])
    return compose(turn, middle - turn @ foot)


def _lattice(
    problem: Problem, mesh: trimesh.Trimesh, world_from_object: FloatArray
) -> tuple[Workspace, float]:
    """The box of the free points, and their spacing (metres, whole tenths of a millimetre)."""
    sides = np.subtract(WORKSPACE.upper, WORKSPACE.lower)
    count = FREE_POINTS if problem.spread else problem.free_points
    spacing = round(float(np.cbrt((np.prod(sides) - float(mesh.volume)) / count)), 4)
    if not problem.spread:
        return WORKSPACE, spacing
    half = np.cbrt(problem.free_points / FREE_POINTS) * sides / 2.0
    middle = apply(world_from_object, np.asarray(mesh.bounds).mean(axis=0, keepdims=True))[0]
    return Workspace(tuple((middle - half).tolist()), tuple((middle + half).tolist())), spacing


def _outside(
    mesh: trimesh.Trimesh, world_from_object: FloatArray, box: Workspace, spacing: float
) -> FloatArray:
    """The points (N, 3) of a lattice in `box` that are outside of the object."""
    # At whole multiples of the spacing, where the published package has its voxels, too.
    first, last = np.ceil(box.bounds[0] / spacing), np.floor(box.bounds[1] / spacing)
    steps = np.indices((last - first).astype(int) + 1).reshape(3, -1).T
    points = (first + steps) * spacing
    signed, _ = mesh_sdf(mesh, apply(inverse(world_from_object), points))
    return points[signed > 0.0]
