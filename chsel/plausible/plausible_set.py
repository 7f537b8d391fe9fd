"""The plausible set: all poses on a grid that cost hardly more than the true one (CHSEL, Sec. V).

    P_eps = {X : C(X) < C(X*) + eps}

With means over points, C may fall as points are added, so that a pose that was rejected comes
back: every step scans all poses, unless the settings say otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chsel.errors import EvaluationError, PoseError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, digest, frozen
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.off_grid import local_members, modes_between, random_subset
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.plausible.pose_scan import PoseGrid, grid_around, plausible_stream, scan_grid
from chsel.problem.poses import check_rigid, inverse
from chsel.problem.registration_problem import RegistrationProblem

_PER_MODE = 4  # members that a mode gets, where there are few modes


@dataclass(frozen=True, eq=False)
class PlausibleSet:
    """Members of the plausible set of one step."""

    world_from_object: FloatArray  # (P, 4, 4), kept for evaluation, the true pose first
    cost: FloatArray  # (P,), C of each
    local: BoolArray  # (P,), True for one that was sought off the grid
    index: IntArray  # (G,), all members on the grid, see PoseGrid, ascending
    index_cost: FloatArray  # (G,)
    true_cost: float  # C(X*)
    settings: PlausibleSettings
    seed: int  # of the rotations
    points_digest: str  # of the known points to which the set belongs
    sdf_digest: str  # of their object's SDF grid

    @property
    def truth(self) -> FloatArray:
        """The true pose T* (4, 4), world_from_object."""
        return self.world_from_object[0]

    @property
    def digest(self) -> str:
        """Digest of the members and their costs."""
        parts = self.world_from_object, self.cost, self.local, self.index, self.index_cost
        return digest(*parts)

    def with_members(self, world_from_object: FloatArray, cost: FloatArray) -> PlausibleSet:
        """The set with members off the grid (N, 4, 4), and their costs (N,), added."""
        return replace(
            self,
            world_from_object=np.concatenate([self.world_from_object, world_from_object]),
            cost=np.concatenate([self.cost, cost]),
            local=np.concatenate([self.local, np.ones(len(cost), dtype=bool)]),
        )


def plausible_set(
    problem: RegistrationProblem,
    world_from_object: FloatArray,
    settings: PlausibleSettings,
    *,
    survivors: PlausibleSet | None = None,
) -> PlausibleSet:
    """The plausible set of a problem around the true pose (4, 4).

    What the true pose itself violates counts into C(X*), so that as much is allowed to others.
    survivors: the set of the step before, for settings without rescan. Raises EvaluationError if
    there are more than MOST_MEMBERS members.
    """
    truth = frozen("world_from_object", world_from_object, (4, 4), error=PoseError)
    check_rigid("world_from_object", truth[None])
    cost = EvaluationCost(problem, settings.cost)
    true_cost = cost.at(truth)
    limit = true_cost + settings.epsilon
    seed = rotation_seed(problem, settings)
    grid = grid_around(truth, settings.grid, seed)
    if survivors is None or settings.rescan:
        index, costs = scan_grid(cost, grid, limit)
    else:
        _check_survivors(survivors, problem, truth, settings, seed)
        costs = cost.evaluate(inverse(grid.poses(survivors.index)), limit=limit)
        index, costs = survivors.index[costs < limit], costs[costs < limit]
    kept = random_subset(len(index), settings.members - 1, plausible_stream(seed, 1))
    poses = grid.poses(index[kept])
    others = ~(poses == truth).all(axis=(1, 2))  # a grid may hold the true pose itself
    members = PlausibleSet(
        world_from_object=np.concatenate([truth[None], poses[others]]),
        cost=np.concatenate([[true_cost], costs[kept][others]]),
        local=np.zeros(1 + int(others.sum()), dtype=bool),
        index=index,
        index_cost=costs,
        true_cost=true_cost,
        settings=settings,
        seed=seed,
        points_digest=problem.points.digest,
        sdf_digest=problem.sdf.digest,
    )
    if settings.modes is not None:
        members = _with_modes(members, cost, grid, limit)
    return _filled(members, cost, limit)


def rotation_seed(problem: RegistrationProblem, settings: PlausibleSettings) -> int:
    """The seed of the rotations that are looked at."""
    return problem.key.seed if settings.grid.seed is None else settings.grid.seed


def _check_survivors(
    survivors: PlausibleSet,
    problem: RegistrationProblem,
    truth: FloatArray,
    settings: PlausibleSettings,
    seed: int,
) -> None:
    fits = survivors.settings.grid == settings.grid and survivors.seed == seed
    fits = fits and survivors.sdf_digest == problem.sdf.digest
    if not fits or not (survivors.truth == truth).all():
        raise EvaluationError(
            "survivors are of another grid of poses; accepted: a set of the same object, true "
            "pose, grid and seed"
        )


def _with_modes(
    members: PlausibleSet, cost: EvaluationCost, grid: PoseGrid, limit: float
) -> PlausibleSet:
    """With members in modes that the grid passes by, in place of others if they are too many."""
    most, count = members.settings.members, len(members.cost)
    assert members.settings.modes is not None
    poses, costs = modes_between(
        grid,
        cost,
        limit,
        members=members.world_from_object,
        settings=members.settings.modes,
        most=max(most - count, most // 2),
        seed=members.seed,
    )
    others = random_subset(count - 1, most - 1 - len(poses), plausible_stream(members.seed, 1)) + 1
    kept = np.concatenate([[0], others])
    on_grid = replace(
        members,
        world_from_object=members.world_from_object[kept],
        cost=members.cost[kept],
        local=members.local[kept],
    )
    return on_grid.with_members(poses, costs)


def _filled(members: PlausibleSet, cost: EvaluationCost, limit: float) -> PlausibleSet:
    """With members off the grid around others, if there are too few, or too few in its modes."""
    settings, around = members.settings, members.world_from_object
    wanted = settings.fill_to - len(around)
    if wanted <= 0:
        around = around[members.local]  # one of each mode
        left = settings.members - len(members.cost)
        wanted = min((_PER_MODE - 1) * len(around), settings.fill_to - len(around), left)
    if wanted <= 0:
        return members
    return members.with_members(*local_members(cost, around, limit, wanted, seed=members.seed))
