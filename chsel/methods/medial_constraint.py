"""Medial Constraint (CHSEL, Sec. V-D): balls of free space must miss the object, contacts touch it.

Its cost is searched by CMA-ES, and by CMA-ME as well (Sec. V-H).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.cost.objective import costs_of
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Places, locate, places_for, squared_clearances
from chsel.numerics.compiler import compiled, implements, inner, spliced
from chsel.numerics.elementary import logs
from chsel.numerics.pose_tuples import all_finite, decode, finite, pose_at
from chsel.numerics.threads import parallel_for, require_ieee_arithmetic
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.points import VoxelGrid, Workspace
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.sdf_lookup import DistanceField, distance_field, distance_in_place
from chsel.problem.search_space import PlaneSettings, SE3Space, SearchSpace, search_space
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd.archive import Batch, batch_of, evaluated, rank
from chsel.qd.emitters import EmitterSettings, fill_archive
from chsel.qd.evolution_kernels import Strategy, ask, stopped, strategy_around, tell
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    ArchiveSettings,
    OutputSettings,
    ranked_hypotheses,
    select_elites,
    sized_archive,
)

MOST_GENERATIONS = 20_000
MOST_SAMPLES = 100_000
MOST_SIGMA = 1e6
_BLOCK = 50  # generations that are drawn at a time, or fewer
_MOST_DRAWN = 1_000_000  # normal draws held at once by a run, 8 bytes each
_RUN, _FINAL = 0, 1  # of a single run: which stream its generations and its result come from
MOST_VOXELS = 30_000_000
_TOLERANCE = 2e-3  # half sides, by which a ball may stick out of the one that holds it
_POSES_PER_THREAD = 100  # fewer are costed faster than a thread wakes up


class Balls(NamedTuple):
    """Balls in the world."""

    centres: FloatArray  # (N_b, 3), metres
    radii: FloatArray  # (N_b,), metres


def medial_balls(
    free: FloatArray, workspace: Workspace, *, resolution: float, inflation: float
) -> Balls:
    """Return balls within the known-free voxels of a workspace that cover them but for `inflation`.

    Largest first. Each is the largest that touches no voxel that is not free, around a centre that
    no ball covers so far; of equals, the first in row-major order.

    free (N, 3): centres of free voxels of side `resolution`, metres, or any points, which make the
    voxels free that hold them. All else is not free, nor is anything beyond the workspace.
    inflation: metres by which a ball may be inflated to cover another.
    Raises SettingError where the free points span too many voxels.
    """
    margin = 1e-6 * resolution
    (lower, upper) = workspace.bounds
    inside = free[((free >= lower - margin) & (free <= upper + margin)).all(axis=1)]
    if len(inside) == 0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    flags = VoxelGrid.around(inside, resolution, most=MOST_VOXELS).flags
    squared = np.empty(flags.shape, dtype=np.int64)
    squared_clearances(flags, squared, 1)
    medial = _is_medial(squared)
    voxels = np.argwhere(medial)
    radii = np.sqrt(squared[medial].astype(np.float64))  # half sides
    order = np.argsort(-squared[medial], kind="stable")
    chosen = order[_covering(voxels[order], radii[order], 2.0 * inflation / resolution)]
    centres = inside.min(axis=0) + (voxels[chosen] - 1) * resolution
    return Balls(centres, radii[chosen] * (resolution / 2.0))


def _is_medial(squared: IntArray) -> BoolArray:
    """Return flags (nx, ny, nz) of voxels whose ball, by squared clearance, is in no other."""
    inner = squared[1:-1, 1:-1, 1:-1]
    radii = np.sqrt(squared.astype(np.float64))
    medial = np.zeros(squared.shape, dtype=np.bool_)
    own, kept = radii[1:-1, 1:-1, 1:-1], inner > 0
    for offset in np.ndindex(3, 3, 3):
        apart = 2.0 * math.sqrt(sum((step - 1) ** 2 for step in offset))
        sides = zip(offset, inner.shape, strict=True)
        around = tuple(slice(step, step + side) for step, side in sides)
        if apart > 0.0:
            kept &= (apart + own > radii[around] + _TOLERANCE) | (squared[around] <= inner)
    medial[1:-1, 1:-1, 1:-1] = kept
    return medial


@compiled
def _covering(voxels: IntArray, radii: FloatArray, inflation: float) -> IntArray:
    """Return indices of balls that, inflated, cover all: each the next not yet covered."""
    covered, chosen = np.zeros(len(radii), dtype=np.bool_), np.empty(len(radii), dtype=np.int64)
    count = 0
    for i in range(len(radii)):
        if not covered[i]:
            chosen[count] = i
            count += 1
            for j in range(i, len(radii)):
                x, y = voxels[i, 0] - voxels[j, 0], voxels[i, 1] - voxels[j, 1]
                z, margin = voxels[i, 2] - voxels[j, 2], radii[i] + inflation - radii[j]
                covered[j] |= 4.0 * (x * x + y * y + z * z) <= margin * margin
    return chosen[:count].copy()


@dataclass(frozen=True)
class MedialCostSettings(CheckedSettings):
    """Settings of the Medial Constraint cost."""

    inflation: Annotated[float, not_negative] = 0.04  # of balls, to cover others, at most, metres
    # Weights of the two means; a ball_scale of 0 ignores free space, as the authors' released code
    # does, whose balls never enter the cost.
    ball_scale: Annotated[float, not_negative] = 1.0
    known_scale: Annotated[float, not_negative] = 1.0  # of known points
    lookup: Annotated[str, one_of(*LOOKUPS)] = "trilinear"  # how the SDF is read, see SdfGrid.at
    outside: Annotated[str, one_of(*OUTSIDE)] = "surface_point"  # and beyond its box

    presets: ClassVar[Presets] = {
        "paper": {"inflation": 0.02, "lookup": "nearest"},
        "reference": {
            "inflation": 0.02,
            "ball_scale": 0.0,
            "lookup": "nearest",
            "outside": "bounding_box",
        },
    }


class MedialModel(NamedTuple):
    """Data of the cost, but the pose."""

    field: DistanceField  # of the object
    centres: FloatArray  # (3, N_b), of the balls, world, metres
    radii: FloatArray  # (N_b,)
    known: FloatArray  # (3, N_k), world, metres
    known_sdf: FloatArray  # (N_k,)
    ball_scale: float  # of the mean over balls
    known_scale: float  # of the mean over known points


class MedialCost:
    """C_M(X) = mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, in m^2.

    Over the balls (c_b, r_b) of the free voxels in the workspace, and the points x_k of known
    signed distance v_k. Occupied points have no term. A mean over nothing is 0. space: of the
    vectors whose costs are asked for. balls: others than those of the problem's free points.
    """

    def __init__(
        self,
        problem: RegistrationProblem,
        settings: MedialCostSettings | None = None,
        *,
        space: SearchSpace | None = None,
        balls: Balls | None = None,
    ) -> None:
        require_ieee_arithmetic()
        settings = settings or MedialCostSettings()
        self.space = space or SE3Space()
        self.space_arrays = self.space.arrays
        if balls is None:
            free = problem.points.free if settings.ball_scale > 0.0 else np.zeros((0, 3))
            resolution, inflation = problem.free_resolution, settings.inflation
            balls = medial_balls(
                free, problem.workspace, resolution=resolution, inflation=inflation
            )
        self.balls = balls
        self.model = MedialModel(
            field=distance_field(problem.sdf, settings.lookup, outside=settings.outside),
            centres=balls.centres.T.copy(),
            radii=balls.radii,
            known=problem.points.known.T.copy(),
            known_sdf=problem.points.sdf.copy(),
            ball_scale=settings.ball_scale,
            known_scale=settings.known_scale,
        )

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Return costs (B,) of vectors (B, d) of the search space."""
        return self.evaluate(self.space.poses(vectors))

    def evaluate(self, poses: Poses) -> FloatArray:
        """Return costs (B,) of poses; infinite for one that is not finite."""
        costs = np.empty(len(poses))
        run = partial(_fill_costs, self.model, poses.numbers, costs)
        parallel_for(run, len(poses), scratch=self.work, least=_POSES_PER_THREAD)
        return costs

    def work(self) -> Places:
        """Return scratch for one thread."""
        return places_for(max(len(self.model.radii), len(self.model.known_sdf)))


@compiled
def _fill_costs(model, poses, out, first, last, places):
    for n in range(first, last):
        out[n] = _cost(model, pose_at(poses, n), places)


@implements(costs_of, MedialModel)
def _medial_costs_of(model, space, vectors, costs, places):
    for n in range(len(vectors)):
        costs[n] = np.inf
        if all_finite(vectors[n]):
            costs[n] = _cost(model, decode(space, vectors[n]), places)


@inner
def _cost(model, pose, places):
    """Return C_M, each mean scaled; infinite for a pose that is not finite."""
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, places)
    cost += model.known_scale * _known_mean(model, pose, places)
    return cost if cost < np.inf else np.inf  # NaN is infinite, too


@spliced
def _ball_mean(model, pose, places):
    """Return the mean square of how deep balls reach into the object."""
    field, radii = model.field, model.radii
    xs, ys, zs = model.centres[0], model.centres[1], model.centres[2]
    locate(pose, field.box, xs, ys, zs, places, len(radii))
    total = 0.0
    for n in range(len(radii)):
        if places.beyond[n] < radii[n] * radii[n]:
            s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
            depth = max(radii[n] - s, 0.0)
            total += depth * depth
    return total / max(len(radii), 1)


@spliced
def _known_mean(model, pose, places):
    """Return the mean square of s - v over points of known signed distance v, 0 for contacts."""
    field, known_sdf = model.field, model.known_sdf
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    locate(pose, field.box, xs, ys, zs, places, len(known_sdf))
    total = 0.0
    for n in range(len(known_sdf)):
        s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
        difference = s - known_sdf[n]
        total += difference * difference
    return total / max(len(known_sdf), 1)


@dataclass(frozen=True)
class CmaEsSettings(CheckedSettings):
    """Settings of CMA-ES."""

    # "per_start" a run from each of E_0, of which each gives the best pose that it met; "single"
    # one run from the first of E_0, whose last distribution gives all poses.
    starts: Annotated[str, one_of("per_start", "single")] = "per_start"
    # Samples of a generation; by default 4 + floor(3 ln d) in d dimensions, for a single run at
    # least as many as there are hypotheses.
    population: Annotated[int | None, positive, at_most(MOST_SAMPLES)] = None
    # First step size, metres and entries of the 6-D rotation alike.
    sigma0: Annotated[float, positive, at_most(MOST_SIGMA)] = 0.1
    # At most; by default 100 + floor(150 (d + 3)^2 / sqrt(population)), as in pycma.
    generations: Annotated[int | None, not_negative, at_most(MOST_GENERATIONS)] = None
    # A run ends when no cost of a generation is above the lowest so far by more than this, m^2.
    tolfun: Annotated[float, not_negative] = 1e-8

    presets: ClassVar[Presets] = {
        "paper": {"tolfun": 1e-5},
        "reference": {"starts": "single", "tolfun": 1e-5},
    }

    def size(self, dimension: int, count: int) -> int:
        """Return samples of a generation in `dimension` dimensions, for `count` hypotheses."""
        if self.population is not None:
            return self.population
        usual = 4 + math.floor(3.0 * float(logs(float(dimension))))
        return max(usual, min(count, MOST_SAMPLES)) if self.starts == "single" else usual

    def most_generations(self, dimension: int, size: int) -> int:
        """Return the most generations of a run in `dimension` dimensions with such samples."""
        if self.generations is not None:
            return self.generations
        return 100 + math.floor(150.0 * (dimension + 3.0) * (dimension + 3.0) / math.sqrt(size))


class Run(NamedTuple):
    """State of one run in d dimensions."""

    strategy: Strategy  # of CMA-ES
    batch: Batch  # a generation; value (L,): minus the costs
    best: FloatArray  # (d,), the vector of lowest cost so far
    cost: FloatArray  # (1,), its cost
    generations: IntArray  # (1,), so far
    ended: BoolArray  # (1,)


def evolved(
    objective: MedialCost,
    initial_set: Poses,
    *,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> FloatArray:
    """Return search vectors (B, d) of the estimates that CMA-ES finds from E_0."""
    vectors = objective.space.encode(initial_set)
    runs = run_all(objective, vectors, settings=settings, key=key, observer=observer)
    if settings.starts == "per_start":
        return np.stack([run.best for run in runs])
    samples = np.empty(vectors.shape)
    _draw(runs[0].strategy, normals(key.stream(Purpose.CMA_ES, _FINAL), vectors.shape), samples)
    return samples


@compiled
def _draw(strategy: Strategy, normals: FloatArray, samples: FloatArray) -> None:
    ask(strategy, normals, samples)


def run_all(
    objective: MedialCost,
    vectors: FloatArray,
    *,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> list[Run]:
    """Return a run from each of vectors (B, d), or from the first, to their ends, by blocks."""
    starts = vectors[:1] if settings.starts == "single" else vectors
    dimension = vectors.shape[1]
    size = settings.size(dimension, len(vectors))
    total = settings.most_generations(dimension, size)
    runs = [
        Run(
            strategy=strategy_around(start, size, sigma0=settings.sigma0),
            batch=batch_of(size, dimension, measures=0),
            best=start.copy(),
            cost=np.array([cost]),
            generations=np.zeros(1, dtype=np.int64),
            ended=np.zeros(1, dtype=np.bool_),
        )
        for start, cost in zip(starts, objective.costs(starts).tolist(), strict=True)
    ]
    streams = [key.stream(Purpose.CMA_ES, _RUN + index) for index in range(len(runs))]
    block = max(1, min(_BLOCK, _MOST_DRAWN // (size * dimension)))
    _trace(observer, runs)

    def advance(first: int, last: int, work: Any) -> None:
        for run, stream in zip(runs[first:last], streams[first:last], strict=True):
            if not run.ended[0]:
                count = min(block, total - int(run.generations[0]))
                drawn = normals(stream, (count, size, dimension))
                evolve(objective.model, objective.space_arrays, work, run, drawn, settings.tolfun)

    for done in range(0, total, block):
        parallel_for(advance, len(runs), scratch=objective.work)
        _trace(observer, runs)
        observer.progress("cma_es", min(done + block, total), total)
        if all(run.ended[0] for run in runs):
            break
    return runs


def _trace(observer: Observer, runs: list[Run]) -> None:
    """Show the observer the best vector of each run so far."""
    generation = max(int(run.generations[0]) for run in runs)
    vectors = np.stack([run.best for run in runs])
    costs = np.array([run.cost[0] for run in runs])
    observer.trace("cma_es", generation, vectors, costs)


@compiled
def evolve(
    model: Any, space: Any, work: Any, run: Run, normals: FloatArray, tolerance: float
) -> None:
    """Run generations of CMA-ES (Hansen, 2016), as many as normals (G, L, d), or to the end.

    The better half of a generation are parents, weighted by rank, all weights positive.
    """
    strategy, batch = run.strategy, run.batch
    vectors = batch.vectors
    costs = batch.objectives
    value = batch.value
    order = batch.order
    for generation in range(len(normals)):
        if run.ended[0]:
            break
        ask(strategy, normals[generation], vectors)
        costs_of(model, space, vectors, costs, work)
        for i in range(len(costs)):
            value[i] = -costs[i]
        rank(batch.status, value, order)
        if costs[order[0]] < run.cost[0]:
            run.cost[0] = costs[order[0]]
            for j in range(len(run.best)):
                run.best[j] = vectors[order[0], j]
        tell(strategy, vectors, order, max(len(costs) // 2, 1))
        run.generations[0] += 1
        is_level = not costs[order[len(order) - 1]] - run.cost[0] > tolerance  # NaN: all infinite
        run.ended[0] = is_level or stopped(strategy, order, batch.status, value)


@dataclass(frozen=True)
class MedialConstraintSettings:
    """Settings of Medial Constraint."""

    cost: MedialCostSettings = field(default_factory=MedialCostSettings)  # C_M
    cma_es: CmaEsSettings = field(default_factory=CmaEsSettings)  # of the runs
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {}  # those of its groups


class MedialConstraint(ConfiguredMethod[MedialConstraintSettings]):
    """Evolves poses from E_0; costs are in m^2; E_l is not used."""

    settings_class = MedialConstraintSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        space = search_space(self.settings.plane, problem.sdf)
        objective = MedialCost(problem, self.settings.cost, space=space)
        initial_set = Poses.of(problem.initial_set)
        settings = self.settings.cma_es
        vectors = evolved(
            objective, initial_set, settings=settings, key=problem.key, observer=observer
        )
        estimates = space.poses(vectors)
        return ranked_hypotheses(objective, estimates, elites=estimates)


TOLERANCE = 1e-5  # m^2, of a mean square: that of 3 mm
_ARCHIVE = ArchiveSettings("position_2", 40, tolerance_per_point=0.0, tolerance=TOLERANCE)
_EMITTER = EmitterSettings(iterations=500, sigma0=1.0, rate=0.05)
_OUTPUT = OutputSettings(
    "lowest", ratio=5.0, tolerance_per_point=0.0, free_tolerance=TOLERANCE, margin=None
)


@dataclass(frozen=True)
class MedialConstraintCmaMeSettings:
    """Settings of Medial Constraint with CMA-ME."""

    cost: MedialCostSettings = field(default_factory=MedialCostSettings)  # C_M
    cma_es: CmaEsSettings = field(default_factory=CmaEsSettings)  # of the runs
    archive: ArchiveSettings = _ARCHIVE  # tolerances in m^2, as the cost is
    emitter: EmitterSettings = _EMITTER  # CMA-ME
    output: OutputSettings = _OUTPUT  # tolerances in m^2
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {
        "paper": {  # without effect, as no estimate is left out
            "archive": {"tolerance_per_point": 1e-3, "tolerance": 1e-6}
        },
        "reference": {},
    }


class MedialConstraintCmaMe(ConfiguredMethod[MedialConstraintCmaMeSettings]):
    """CMA-ES from E_0, then CMA-ME over an archive around what it finds; costs are in m^2."""

    settings_class = MedialConstraintCmaMeSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        settings = self.settings
        key = problem.key
        count = len(problem.initial_set)
        space = search_space(settings.plane, problem.sdf)
        grid = settings.archive
        objective = MedialCost(problem, settings.cost, space=space)
        measure = measure_named(grid.measure, planar=settings.plane is not None)
        # E' <- CMA-ES on E_0; as poses, so that it holds what hypotheses can be
        initial_set = Poses.of(problem.initial_set)
        vectors = evolved(
            objective, initial_set, settings=settings.cma_es, key=key, observer=observer
        )
        estimates = evaluated(objective, measure, vectors=space.encode(space.poses(vectors)))
        # M <- the archive that measures of E' size, holding E' and E_l
        known = len(problem.points.known)
        archive = sized_archive(
            estimates, measure, settings=grid, known_count=known, dimension=space.dimension
        )
        low_cost_set = space.encode(Poses.of(problem.low_cost_set))
        archive.update_cells(estimates, evaluated(objective, measure, vectors=low_cost_set))
        # M <- CMA-ME(M, C_M, n_o)
        first = space.encode(initial_set[:1])[0]
        best = archive.best_solution
        start = first if settings.emitter.start == "initial" else best
        fill_archive(
            "cma_me",
            objective,
            archive=archive,
            start=start,
            count=count,
            settings=settings.emitter,
            key=key,
            observer=observer,
        )
        # E <- cells of M with the |E_0| lowest costs
        stream, elites = key.stream(Purpose.RESAMPLE), space.poses(archive.solutions)
        chosen = select_elites(
            archive.costs,
            elites,
            problem=problem,
            space=space,
            settings=settings.output,
            stream=stream,
        )
        snapshot = archive.snapshot(settings.emitter.iterations, 0)
        return ranked_hypotheses(
            objective,
            elites[chosen],
            cells=archive.occupied[chosen],
            elites=elites,
            archive=snapshot,
        )
