"""Contact-anchored search: our own method, for sets that are close to the plausible set."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from chsel.anchors import AnchorSettings, anchors_of
from chsel.arrays import FloatArray, IntArray
from chsel.cost_settings import CostSettings
from chsel.emitters import update_cells
from chsel.engine import CompiledCost, poses_of
from chsel.errors import require_at_most, require_choice, require_positive
from chsel.far_apart import far_apart
from chsel.kernels.anchors import DRAWS, best_for, sample
from chsel.interior import VoxelGrid
from chsel.kernels.coarse_score import Coarse
from chsel.kernels.cost import Model
from chsel.kernels.energy import energies_below, found_around
from chsel.kernels.facility import locate_facilities
from chsel.kernels.levenberg_marquardt import Twists, fit_for, fit_poses
from chsel.kernels.region import box_of, triple
from chsel.kernels.threshold_walk import DRAWS as MOVE_DRAWS
from chsel.kernels.threshold_walk import Stride, chains_from, steps_for, walk_below
from chsel.measures import measure_named
from chsel.objective import Objective
from chsel.observer import NullObserver, Observer
from chsel.online import OnlineSettings
from chsel.points import KnownPoints
from chsel.pose import compose
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.sdf import SdfGrid
from chsel.selection import ArchiveSettings, ranked_hypotheses, sized_archive
from chsel.space import PlaneSettings, SE2Space, SearchSpace, search_space, transforms_of
from chsel.streams import Purpose, StreamKey, normals, uniforms
from chsel.surface import surface_points
from chsel.threads import spread


@dataclass(frozen=True)
class Effort:
    samples: int = 60_000
    kept: int = 200
    first_steps: int = 6
    refined: int = 100
    steps: int = 15
    descents: int = 96
    descent_moves: int = 266
    chains: int = 96
    moves: int = 300


EFFORTS = {
    "small": Effort(40_000, 64, 12, 40, 15, 24, 60, 24, 150),
    "medium": Effort(),
    "large": Effort(250_000, 504, 6, 150, 15, 120, 500, 120, 1000),
}
KEPT_STATES = 6
POOL = 400


@dataclass(frozen=True)
class AnchoredSettings:
    size: str = "medium"
    noise: float = 0.001
    penetration_tolerance: float = 0.0
    coarse_level: float = -0.01
    coarse_scale: float = 0.3
    most_contacts: int = 32
    fit_level: float = -0.003
    limit_noise: float = 2.0
    limit_ratio: float = 1.3
    lever: float = 0.15
    anchors: AnchorSettings = field(default_factory=AnchorSettings)
    effort: Effort | None = None
    archive: ArchiveSettings = ArchiveSettings(measure="object_xy", outliers="none")
    online: OnlineSettings = OnlineSettings(update="own")
    plane: PlaneSettings | None = None


class Anchored:
    def __init__(self, settings: AnchoredSettings | None = None) -> None:
        self.settings = settings or AnchoredSettings()

    @property
    def online(self) -> OnlineSettings:
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        from time import perf_counter as pc
        T = self.times = {}
        t0 = pc()
        settings = self.settings
        effort = settings.effort or EFFORTS[settings.size]
        sdf, key = problem.sdf, problem.key
        space = search_space(settings.plane, sdf)
        points = _in_telling_order(problem.points)
        alpha = -settings.penetration_tolerance
        known_scale = 1.0 / max(len(points.known), 1)
        cost = CompiledCost(
            sdf,
            points,
            CostSettings(
                penetration_tolerance=-0.0,
                free_scale=1.0,
                occupied_scale=1.0,
                known_scale=known_scale,
                gradient="exact",
            ),
            free_resolution=problem.free_resolution,
            way="tree",
        )
        model = cost.model
        coarse = cost.at_level(sdf, settings.coarse_level)
        coarse = coarse._replace(free_scale=0.05)
        fitting = cost.at_level(sdf, settings.fit_level)
        centre, spread_matrix = shape_of(sdf)
        T["build"] = pc() - t0; t0 = pc()
        rough = rough_of(sdf, points, problem, settings)
        T["rough"] = pc() - t0; t0 = pc()
        anchors = anchors_of(sdf, points, problem.workspace, space, settings.anchors)
        T["anchors"] = pc() - t0; t0 = pc()
        draws = key.stream(Purpose.ANCHORS).random((effort.samples, DRAWS))
        T["draws"] = pc() - t0; t0 = pc()
        poses = sampled(rough, space, anchors, draws, effort.kept)
        T["sample"] = pc() - t0; t0 = pc()
        self.sampled = poses
        given = np.concatenate([problem.initial_set, problem.low_cost_set])
        if len(problem.low_cost_set):
            more = poses_of(np.concatenate([problem.initial_set, problem.low_cost_set]))
            e = energies(coarse, more)
            more = more[np.argsort(e, kind="stable")[:60]]
            poses = np.concatenate([poses, more])
        basis = np.eye(6)
        planar = isinstance(space, SE2Space)
        if planar:
            basis = np.zeros((3, 6))
            basis[0, :3], basis[1, 3:], basis[2, 3:] = space.axis, space.e_u, space.e_v
        basis[:, :3] /= settings.lever
        twists = Twists(basis, triple(centre), 0.08, 0.5)
        fit(fitting, twists, poses, effort.first_steps)
        e = energies(model, poses)
        order = np.argsort(e, kind="stable")
        better = poses[order[: effort.refined]]
        fit(fitting, twists, better, effort.steps)
        poses = np.concatenate([better, poses[order[effort.refined :]]])
        e = energies(model, poses)
        order = np.argsort(e, kind="stable")
        poses, e = poses[order], e[order]
        T["fit"] = pc() - t0; t0 = pc()
        self.fitted = e.copy()
        bounds = problem.workspace.bounds
        stride = Stride(
            0.01, 0.0003, 0.03, 1.1, 0.97, 6.0, 0.6, planar,
            triple(space.axis) if planar else (0.0, 0.0, 0.0), triple(centre),
            triple(bounds[0] - settings.anchors.margin), triple(bounds[1] + settings.anchors.margin),
        )
        # descend
        n = min(effort.descents, len(poses))
        draws = moves(key.stream(Purpose.WALKS, 0), n, effort.descent_moves)
        T["draws"] += pc() - t0; t0 = pc()
        floor = settings.limit_noise * settings.noise
        chains = walked(model, stride, floor, poses[:n], e[:n], draws, 0)
        poses = np.concatenate([chains.poses, poses[n:]])
        e = np.concatenate([chains.energies, e[n:]])
        T["descend"] = pc() - t0; t0 = pc()
        least = float(e.min())
        self.least = least
        limit = max(settings.limit_noise * settings.noise, settings.limit_ratio * least + 0.5 * settings.noise)
        below = e <= limit
        starts, start_e = poses[below], e[below]
        order = np.argsort(start_e, kind="stable")
        starts, start_e = starts[order], start_e[order]
        chosen = far_apart(embedded(starts, centre, spread_matrix), effort.chains)
        chosen = np.resize(chosen, effort.chains)
        draws = moves(key.stream(Purpose.WALKS, 1), effort.chains, effort.moves)
        T["draws"] += pc() - t0; t0 = pc()
        chains = walked(model, stride, limit, starts[chosen], start_e[chosen], draws, KEPT_STATES)
        T["spread"] = pc() - t0; t0 = pc()
        self.acceptance = chains.moved.mean() / effort.moves
        kept, kept_e = chains.kept.reshape(-1, 12), chains.kept_energies.reshape(-1)
        good = kept_e <= limit
        pool = np.concatenate([starts, kept[good]])
        pool_e = np.concatenate([start_e, kept_e[good]])
        pick = [0, *(1 + np.floor(np.arange(min(POOL, len(pool)) - 1) * (len(pool) - 1) / max(min(POOL, len(pool)) - 1, 1)).astype(int))]
        pool, pool_e = pool[pick], pool_e[pick]
        self.pool = pool
        count = min(len(problem.initial_set), len(pool))
        chosen = facilities(embedded(pool, centre, spread_matrix), np.ones(len(pool)), count)
        T["choose"] = pc() - t0; t0 = pc()
        transforms = compose(pool[:, :9].reshape(-1, 3, 3), pool[:, 9:])
        objective = Objective(cost, space)
        vectors = space.encode(transforms)
        measure = measure_named(settings.archive.measure, planar=planar)
        measures = objective.measures(measure, vectors)
        archive = sized_archive(measure, measures, pool_e, settings.archive, len(points.known), space.dimension)
        update_cells(archive, objective, vectors, pool_e)
        elites = transforms_of(space, archive.solutions)
        cells = archive.cells_of(measures[chosen])
        found = ranked_hypotheses(objective, transforms[chosen], cells, elites, archive.snapshot(0, 0))
        T["archive"] = pc() - t0; t0 = pc()
        return found


def _in_telling_order(points: KnownPoints) -> KnownPoints:
    order = far_apart(points.known, 64)
    rest = np.ones(len(points.known), dtype=bool)
    rest[order] = False
    order = np.concatenate([order, np.flatnonzero(rest)])
    return replace(points, known=points.known[order], known_sdf=points.sdf[order])


def rough_of(sdf, points, problem, settings):
    values, inside, depth = sdf.derived("rough", lambda: _rough(sdf))
    n = min(len(points.known), settings.most_contacts)
    free = points.free
    reach = settings.anchors.margin + sdf.diameter
    low, high = problem.workspace.bounds
    near = ((free >= low - reach) & (free <= high + reach)).all(axis=1)
    free = free[near]
    box = box_of(sdf.origin, sdf.resolution, sdf.shape)
    weights = settings.coarse_scale * depth * (300.0 / max(len(depth), 1))
    if len(free):
        voxels = VoxelGrid.around(free, problem.free_resolution)
        vbox = box_of(voxels.origin, problem.free_resolution, voxels.flags.shape)
        flags = voxels.flags.reshape(-1)
    else:
        vbox, flags, inside, weights = box, np.zeros(1, dtype=bool), inside[:0], weights[:0]
    return Coarse(box, values, points.known[:n].T.copy(), points.sdf[:n].copy(), 1.0 / max(n, 1), inside.T.copy(), weights, vbox, flags)


def _rough(sdf):
    values = sdf.values.astype(np.float32).reshape(-1)
    deepest = -sdf.values.min()
    nodes = np.argwhere(sdf.values < -0.3 * deepest)
    depth = -sdf.values[tuple(nodes.T)]
    if len(nodes) > 4000:
        pick = np.floor(np.arange(4000) * (len(nodes) / 4000)).astype(int)
        nodes, depth = nodes[pick], depth[pick]
    chosen = far_apart(nodes.astype(float), 150)
    return values, sdf.origin + nodes[chosen] * sdf.resolution, depth[chosen]


def shape_of(sdf: SdfGrid) -> tuple[FloatArray, FloatArray]:
    return sdf.derived("shape", lambda: _shape(surface_points(sdf, 400, StreamKey(0, 0).stream(Purpose.ANCHORS))))


def _shape(surface):
    centre = surface.mean(axis=0)
    away = surface - centre
    covariance = away.T @ away / len(away)
    return centre, np.linalg.cholesky(covariance + 1e-12 * np.eye(3))


def embedded(poses: FloatArray, centre: FloatArray, root: FloatArray) -> FloatArray:
    """world_from_object of the centre and the principal spread: |a - b|^2 = mean |x_a - x_b|^2."""
    rotations = poses[:, :9].reshape(-1, 3, 3).swapaxes(1, 2)
    position = ((centre - poses[:, 9:])[:, None, :] * rotations).sum(axis=2)
    axes = (rotations[:, :, :, None] * root[None, None]).sum(axis=2)
    return np.ascontiguousarray(np.concatenate([position, axes.reshape(-1, 9)], axis=1))


def energies(model: Model, poses: FloatArray) -> FloatArray:
    out = np.empty(len(poses))
    spread(
        lambda first, last, found: energies_below(model, poses, np.inf, out, first, last, found),
        len(poses), lambda: found_around(model), least=50,
    )
    return out


def sampled(rough, space, anchors, draws, most):
    made = []

    def scratch():
        made.append(best_for(most))
        return made[-1]

    spread(
        lambda first, last, best: sample(rough, space.arrays, anchors, draws, best, first, last),
        len(draws), scratch, least=1000,
    )
    counts = [int(best.state[0]) for best in made]
    scores = np.concatenate([best.scores[:count] for best, count in zip(made, counts)])
    numbers = np.concatenate([best.numbers[:count] for best, count in zip(made, counts)])
    poses = np.concatenate([best.poses[:count] for best, count in zip(made, counts)])
    order = np.lexsort([numbers, scores])[:most]
    return poses[order]


def fit(model, twists, poses, steps):
    spread(
        lambda first, last, scratch: fit_poses(model, twists, poses, steps, first, last, scratch),
        len(poses), lambda: fit_for(model, len(twists.basis)), least=8,
    )


def moves(stream, chains, count):
    draws = 2.0 * stream.random((chains, count, MOVE_DRAWS)) - 1.0
    draws[:, :, 3:] *= np.sqrt(3.0)
    draws[:, :, 1:3] = 0.5 * draws[:, :, 1:3] + 0.5
    draws[:, :, 0] = np.power(10.0, -0.3 + 0.6 * draws[:, :, 0])
    return draws


def walked(model, stride, floor, poses, e, draws, kept):
    chains = chains_from(poses, e, kept)
    spread(
        lambda first, last, steps: walk_below(model, stride, floor, chains, draws, first, last, steps),
        len(poses), lambda: steps_for(model), least=2,
    )
    return chains


def facilities(points, weights, count):
    chosen = np.zeros(count, dtype=np.int64)
    size = len(points)
    done = locate_facilities(points, weights, 1, chosen, np.empty(size), np.empty((size, size)))
    return chosen[:done]
