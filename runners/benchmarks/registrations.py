"""Registrations by this library and by the published package, of the same problems."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import trimesh

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import ChselError
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings, first_initial_set
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import (
    ArchiveSnapshot,
    Hypotheses,
    Observer,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from chsel.problem.settings import in_preset
from chsel.problem.streams import StreamKey
from runners.benchmarks.timing import Row, Steps, in_turn
from runners.objects.loader import ObjectConfig, load_object
from runners.published_package.process import PublishedPackage

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


WHAT = (
    "Timed is one call, from arrays of points to poses: constructors are in it, building the "
    "signed distance grid and what follows from it alone is not. Both packages read the same grid "
    "and start from the same poses, one thread each, one after the other. The presets reference "
    "and paper do as many steps as the package; default and the method anchored are measured as "
    "they ship: they start from further poses, and stop by their own rules."
)
PACKAGE = "package"  # begins the names of its registrations
PRESETS = ("reference", "paper", "default")
EQUAL_STEPS = ("reference", "paper")
"""Presets that do as many steps as the package; all else is registered as it ships."""
SIZES = tuple(f"anchored, {size}" for size in ("small", "medium", "adaptive"))
OURS = (*PRESETS, *SIZES)
"""Registrations by this library: presets of CHSEL, and sizes of the method `anchored`."""


class BenchmarkError(ChselError):
    """Both sides would not do the same work."""


def method(name: str, steps: Steps, search: int) -> Method:
    """One of OURS: with all steps done, or as it ships but for a search that is longer."""
    if name in SIZES:
        settings = replace(preset_settings("anchored"), size=name.removeprefix("anchored, "))
        return build_method("anchored", settings)
    settings = preset_settings("chsel", name)
    if name in EQUAL_STEPS or search != steps.search:
        settings = replace(settings, emitter=replace(settings.emitter, iterations=search))
    if name in EQUAL_STEPS:
        descent = replace(
            settings.descent, restarts=steps.restarts, iterations=steps.adam, stop_below=None
        )
        settings = replace(settings, descent=descent)
    return build_method("chsel", settings)


def register(
    problem: RegistrationProblem,
    name: str,
    steps: Steps,
    search: int,
    observer: Observer | None = None,
) -> tuple[float, Hypotheses]:
    """Milliseconds from arrays to hypotheses by one of OURS, and these; the SDF grid is there."""
    begun = time.perf_counter()
    fresh = replace(problem, points=replace(problem.points))  # which has nothing computed yet
    found = method(name, steps, search).register(fresh, observer)
    return 1000.0 * (time.perf_counter() - begun), found


def compare(
    name: str,
    steps: Steps,
    repeats: int,
    seed: int,
    package: PublishedPackage | None,
    *,
    equation: bool,
) -> Iterator[Row]:
    """Rows of one of PROBLEMS: OURS, and in turn with them the package.

    The first registration of everyone is not counted. equation: the package with the paper's own
    free term as well, a third as often, the first one included. cost: of the best pose under the
    paper's equation, the same measure for everyone.
    """
    problem = pose(PROBLEMS[name], seed)
    search = steps.long_search if PROBLEMS[name].long else steps.search
    found: dict[str, FloatArray] = {}  # poses (B, 4, 4) by who found them

    def ours(who: str, name: str) -> float:
        taken, hypotheses = register(problem, name, steps, search)
        found[who] = hypotheses.object_from_world
        return taken

    def theirs(who: str, cost: str) -> float:
        assert package is not None
        answer = package.register(
            cost=cost,
            restarts=steps.restarts,
            steps=steps.adam,
            search=search,
            seed=seed,
        )
        # One gradient in an Adam step, one in an iteration of the search.
        gradients = steps.restarts * steps.adam + search
        require_equal("gradients of the package", answer["gradients"], gradients)
        free_points = len(problem.points.free)
        require_equal("free points of the package", answer["free_points"], free_points)
        found[who] = np.array(answer["poses"])
        return 1000.0 * float(answer["seconds"])

    for preset in EQUAL_STEPS:
        timer = StageTimer()
        register(problem, preset, steps, search, timer)
        counted = tuple(timer.iterations.values())
        require_equal("iterations of ours", counted, (steps.restarts * steps.adam, search))
    labels = {one if one in SIZES else f"ours, {one}": one for one in OURS}
    often = {who: partial(ours, who, one) for who, one in labels.items()}
    seldom = {}
    if package is not None:
        package.load(problem, drill(PROBLEMS[name].scale)[0].bounds)
        often[PACKAGE] = partial(theirs, PACKAGE, "default")
        if equation:
            who = f"{PACKAGE}, Eq. 8"
            seldom[who] = partial(theirs, who, "equation")
    samples = in_turn(repeats, often) | in_turn(max(1, repeats // 3), seldom, first_counts=True)
    cost = RelaxedCost.of(problem, in_preset(CostSettings(), "paper"))
    for who, taken in samples.items():
        least = float(cost.evaluate(found[who]).min())
        yield Row("registration", name, who, "ms", taken, cost=least)


def require_equal(what: str, counted: object, expected: object) -> None:
    """Raise BenchmarkError if one side would do less work than the other."""
    if counted != expected:
        raise BenchmarkError(f"{what}: {counted} counted, {expected} expected: nothing to compare")


class StageTimer:
    """An observer that takes the time of the stages, and counts their iterations."""

    snapshot_interval = 0

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.iterations: dict[str, int] = {}
        self._mark = time.perf_counter()

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """The time since the last report is the stage's."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self.iterations[stage] = iteration
        self._mark = now

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Ignore it."""

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Ignore it."""
