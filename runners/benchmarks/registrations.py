"""Timed calls: registrations by this library and by the published package, and others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import ChselError
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads as on_threads
from chsel.plausible.plausible_set import plausible_set
from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.initial_sets import OnlineSettings, first_initial_set
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from chsel.problem.settings import CheckedSettings, in_preset, positive, settings_mapping
from chsel.problem.streams import StreamKey
from runners.command.choices import store
from runners.objects.loader import ObjectConfig, load_object
from runners.published_package.process import PublishedPackage
from runners.sessions.configurations import WORKSPACE

_SDF_RESOLUTION = 0.01
_YAW = 0.5
_THREADS = (1, 2)


@dataclass(frozen=True)
class Steps(CheckedSettings):
    """The amount of work of registrations beside the package, none of which stops early."""

    restarts: Annotated[int, positive] = 10  # of descent
    adam: Annotated[int, positive] = 50  # Adam steps of a restart
    search: Annotated[int, positive] = 100  # CMA-MEGA iterations
    long_search: Annotated[int, positive] = 500  # the same, in the longer row


store("effort", "default", node=settings_mapping(Steps()))


@dataclass(frozen=True)
class Scope:
    """The amount of what is measured."""

    steps: Steps
    repeats: int
    seed: int


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    measure: str  # what was varied or looked at
    case: str  # the value of it
    who: str  # which registration
    unit: str
    samples: tuple[float, ...]  # in the order in which they were taken
    cost: float | None = None  # of the best pose of a registration

    @property
    def median(self) -> float:
        """The middle of the samples."""
        return float(np.median(self.samples))

    @property
    def quartiles(self) -> tuple[float, float]:
        """A quarter of the samples is below the first, a quarter above the second."""
        lower, upper = np.quantile(self.samples, [0.25, 0.75])
        return float(lower), float(upper)

    def mapping(self) -> dict[str, Any]:
        """Return the row as the report's file has it."""
        return {**asdict(self), "median": self.median, "quartiles": self.quartiles}


def in_turn(
    repeats: int, measured: Mapping[str, Callable[[], float]], *, first_counts: bool = False
) -> dict[str, tuple[float, ...]]:
    """Take every measurement once, then all of them again: A B A B, never two at a time.

    first_counts: else each is taken once more, before all others, and that is left out.
    """
    samples: dict[str, list[float]] = {name: [] for name in measured}
    for _ in range(repeats if first_counts else repeats + 1):
        for name, measure in measured.items():
            samples[name].append(measure())
    return {name: tuple(values[-repeats:]) for name, values in samples.items()}


def milliseconds(run: Callable[[], object], count: int = 1) -> float:
    """Return the milliseconds of a run on so many threads."""
    with on_threads(count):
        begun = time.perf_counter()
        run()
        return 1000.0 * (time.perf_counter() - begun)


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
    points = KnownPoints(free=_outside(mesh, world_from_object, spacing=spacing), known=contacts)
    settings = OnlineSettings(hypotheses=problem.hypotheses)
    initial_set = first_initial_set(WORKSPACE, points, key=StreamKey(seed, 0), settings=settings)
    return RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=initial_set,
        workspace=WORKSPACE,
        free_resolution=spacing,
        key=StreamKey(0, 0),
    )


@lru_cache
def drill(scale: float) -> tuple[trimesh.Trimesh, SdfGrid]:
    """Return the mesh of the model, and its signed distance grid."""
    mesh = load_object(
        ObjectConfig("drill", scale, epsilon=0.001, configuration="drill"), Path()
    ).mesh
    return mesh, SdfGrid.from_mesh(mesh, _SDF_RESOLUTION)


def standing(mesh: trimesh.Trimesh) -> FloatArray:
    """Return world_from_object (4, 4): turned, on the floor in the middle of the workspace."""
    lower, upper = np.asarray(mesh.bounds)
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(_YAW))
    foot = np.array([*(lower + upper)[:2] / 2.0, lower[2]])
    middle = np.array([*WORKSPACE.bounds.mean(axis=0)[:2], 0.0])
    return compose(turn, middle - turn @ foot)


def _outside(mesh: trimesh.Trimesh, world_from_object: FloatArray, *, spacing: float) -> FloatArray:
    """Return the points (N, 3) of a lattice in the workspace that are outside of the object."""
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
    """The error that both sides would not do the same work."""


def method(name: str, steps: Steps, *, search: int) -> Method:
    """Return one of OURS: with all steps done, or as it ships but for a search that is longer."""
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
    *,
    steps: Steps,
    search: int,
    observer: Observer | None = None,
) -> tuple[float, Hypotheses]:
    """Return milliseconds from arrays to hypotheses by one of OURS, and these."""
    begun = time.perf_counter()
    fresh = replace(problem, points=replace(problem.points))  # which has nothing computed yet
    found = method(name, steps, search=search).register(fresh, observer)
    return 1000.0 * (time.perf_counter() - begun), found


def compare(
    name: str, scope: Scope, *, package: PublishedPackage | None, equation: bool
) -> Iterator[Row]:
    """Yield rows of one of PROBLEMS: OURS, and in turn with them the package.

    The first registration of everyone is not counted. equation: the package with the paper's own
    free term as well, a third as often, the first one included. cost: of the best pose under the
    paper's equation, the same measure for everyone.
    """
    problem = pose(PROBLEMS[name], scope.seed)
    steps = scope.steps
    search = steps.long_search if PROBLEMS[name].long else steps.search
    found: dict[str, FloatArray] = {}  # poses (B, 4, 4) by who found them

    def ours(who: str, name: str) -> float:
        taken, hypotheses = register(problem, name, steps=steps, search=search)
        found[who] = hypotheses.object_from_world
        return taken

    def theirs(who: str, cost: str) -> float:
        assert package is not None
        effort = {"restarts": steps.restarts, "steps": steps.adam, "search": search}
        answer = package.register(cost=cost, seed=scope.seed, **effort)
        # One gradient in an Adam step, one in an iteration of the search.
        expected = steps.restarts * steps.adam + search, len(problem.points.free)
        if (counted := (answer["gradients"], answer["free_points"])) != expected:
            raise BenchmarkError(
                f"gradients and free points of the package are {counted}, {expected} expected: "
                "nothing to compare"
            )
        found[who] = np.array(answer["poses"])
        return 1000.0 * float(answer["seconds"])

    labels = {one if one in SIZES else f"ours, {one}": one for one in OURS}
    often = {who: partial(ours, who, one) for who, one in labels.items()}
    seldom = {}
    if package is not None:
        package.load(problem, drill(PROBLEMS[name].scale)[0].bounds)
        often[PACKAGE] = partial(theirs, PACKAGE, "default")
        if equation:
            who = f"{PACKAGE}, Eq. 8"
            seldom[who] = partial(theirs, who, "equation")
    repeats = scope.repeats
    samples = in_turn(repeats, often) | in_turn(max(1, repeats // 3), seldom, first_counts=True)
    cost = RelaxedCost.of(problem, in_preset(CostSettings(), "paper"))
    for who, taken in samples.items():
        least = float(cost.evaluate(found[who]).min())
        yield Row("registration", name, who=who, unit="ms", samples=taken, cost=least)


class StageTimer(NullObserver):
    """An observer that takes the time of the stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._mark = time.perf_counter()

    def progress(self, stage: str, iteration: int, total: int) -> None:  # noqa: PLR0917
        """Count the time since the last report for the stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now


def stages(scope: Scope) -> Iterator[Row]:
    """Yield adam, search, and all else of a registration."""
    problem = pose(PROBLEMS["real_20"], scope.seed)
    for name in (*PRESETS, "anchored, adaptive"):
        parts: dict[str, list[float]] = {}
        for _ in range(scope.repeats + 1):
            timer = StageTimer()
            total, _ = register(
                problem, name, steps=scope.steps, search=scope.steps.search, observer=timer
            )
            taken = {stage: 1000.0 * seconds for stage, seconds in timer.seconds.items()}
            for stage, value in (taken | {"other": total - sum(taken.values())}).items():
                parts.setdefault(stage, []).append(value)
        for stage, samples in parts.items():
            yield Row("stage", stage, who=name, unit="ms", samples=tuple(samples[1:]))


def threads(scope: Scope) -> Iterator[Row]:
    """Yield one and two threads, in turn, and how many times as fast two are."""
    for case in ("real_20", "large_20"):
        problem = pose(PROBLEMS[case], scope.seed)
        for name in (*PRESETS, "anchored, medium"):
            once = partial(register, problem, name, steps=scope.steps, search=scope.steps.search)
            samples = in_turn(
                scope.repeats, {str(n): partial(milliseconds, once, n) for n in _THREADS}
            )
            for count, taken in samples.items():
                yield Row("threads", f"{case}, {count}", who=name, unit="ms", samples=taken)
            ratios = np.divide(samples["1"], samples["2"]).tolist()
            yield Row("speed-up", case, who=name, unit="x", samples=tuple(ratios))


def methods(scope: Scope) -> Iterator[Row]:
    """Yield every method in preset default, stopping when it does, in turn."""
    problem = pose(PROBLEMS["real_20"], scope.seed)

    def register_with(name: str) -> None:
        build_method(name).register(replace(problem, points=replace(problem.points)))

    cases = {name: partial(milliseconds, partial(register_with, name)) for name in METHODS}
    for name, taken in in_turn(scope.repeats, cases).items():
        yield Row("method", name, who="default", unit="ms", samples=taken)


def plausible_sets(scope: Scope) -> Iterator[Row]:
    """Yield the set of one step, of 34 million poses, on one thread and on two."""
    settings = plausible_settings("default", 0.001)
    truth = standing(drill(1.0)[0])
    for case in ("real_20", "real_150"):
        once = partial(plausible_set, pose(PROBLEMS[case], scope.seed), truth, settings=settings)
        named = {f"{case}, {n}": partial(milliseconds, once, n) for n in _THREADS}
        for name, taken in in_turn(scope.repeats, named).items():
            yield Row("plausible, threads", name, who="default", unit="ms", samples=taken)


MEASURES: dict[str, Callable[[Scope], Iterator[Row]]] = {
    "stages": stages,
    "threads": threads,
    "methods": methods,
    "plausible_sets": plausible_sets,
}
"""Measurements of this library alone."""
