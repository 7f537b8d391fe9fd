"""Where the object truly is, as far as the data of a real session say, from a pose set by hand.

The first of the two searches by which the authors made the plausible sets of real data: the pose
of least evaluation cost near a guess is T*; the plausible set is then made around it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from chsel.errors import PoseError, SettingError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import MOST_ROTATIONS, EvaluationCostSettings, Offsets
from chsel.plausible.pose_scan import PoseGrid, scan_grid
from chsel.problem.poses import inverse, nearest_rigid, product, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import CheckedSettings, at_most, positive
from chsel.problem.streams import Purpose, normals

_FIRST_LOOK = 4000  # poses that show which costs are worth looking for
_STREAM = 100  # of the plausible rotations' streams, and those after it


@dataclass(frozen=True)
class TruePoseSettings(CheckedSettings):
    """The poses to look at around the guess.

    Each pass after the first looks around the best pose so far, with a reach of one spacing, and
    spacing and angle scaled alike.
    """

    reach: Annotated[float, positive] = 0.08  # along each axis, metres to either side of the guess
    spacing: Annotated[float, positive] = 0.01  # metres between positions
    rotations: Annotated[int, positive, at_most(MOST_ROTATIONS)] = 2000  # beside the guess's
    angle: Annotated[float, positive] = 0.02  # standard deviation of these rotations, radians
    passes: Annotated[int, positive, at_most(10)] = 2
    cost: EvaluationCostSettings = field(default_factory=EvaluationCostSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reach / self.spacing > 20.0:
            raise SettingError(
                f"spacing is {self.spacing} with reach {self.reach}; accepted: at least a "
                "twentieth of it"
            )


@dataclass(frozen=True, eq=False)
class TruePose:
    """The pose of least evaluation cost near a guess."""

    world_from_object: FloatArray  # (4, 4)
    cost: float
    guess_cost: float


def find_true_pose(
    problem: RegistrationProblem, guess: FloatArray, settings: TruePoseSettings | None = None
) -> TruePose:
    """The pose of least evaluation cost near a guess, world_from_object (4, 4).

    problem: that of the last step, when most is known. The least of all poses looked at, exactly.
    """
    settings = settings or TruePoseSettings()
    guess = frozen("guess", guess, (4, 4), error=PoseError)
    best = nearest_rigid("guess", guess[None])[0]
    cost = EvaluationCost(problem, settings.cost)
    least = guess_cost = cost.at(best)
    reach, spacing, angle = settings.reach, settings.spacing, settings.angle
    for n in range(settings.passes):
        half = round(reach / spacing)
        axis = ((-half * spacing, half * spacing, 2 * half + 1),)
        stream = problem.key.stream(Purpose.PLAUSIBLE_ROTATIONS, _STREAM + n)
        turns = rotation_vector(angle * normals(stream, (settings.rotations, 3)))
        rotations = np.concatenate([best[None, :3, :3], product(turns, best[:3, :3])])
        grid = PoseGrid(best[:3, 3], Offsets(axis, axis, axis), rotations)
        best, least = _best(cost, grid, best, least)
        reach, spacing, angle = spacing, spacing * spacing / reach, angle * spacing / reach
    return TruePose(best, least, guess_cost)


def _best(
    cost: EvaluationCost, grid: PoseGrid, best: FloatArray, least: float
) -> tuple[FloatArray, float]:
    """The cheapest pose of a grid and its cost; the best one before if none is cheaper."""
    look = np.arange(0, len(grid), max(1, len(grid) // _FIRST_LOOK))
    look_costs = cost.evaluate(inverse(grid.poses(look)))
    index, costs = scan_grid(cost, grid, min(least, float(look_costs.min())))
    if len(index) == 0:  # none is cheaper than those
        index, costs = look, look_costs
    cheapest = int(np.argmin(costs))
    if not costs[cheapest] < least:
        return best, least
    return grid.poses(index[cheapest : cheapest + 1])[0], float(costs[cheapest])
