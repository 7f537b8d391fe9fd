"""Whether points bear out a pose that another estimator gives, beside all poses that they allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.methods.anchored.anchored import Anchored
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.problem.noise import noise_model
from chsel.problem.pose_distances import distances_apart_from, middle, turned
from chsel.problem.poses import Poses, apply, inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.surface import signed_distances
from chsel.problem.trust import (
    DETERMINED,
    NOTHING,
    SURE_TURN,
    explaining,
    mode_width,
    pose_energies,
    sure_within,
)
from chsel.session.judging import noise_of, search_for

CONFIRMED = "confirmed"
"""All poses that explain the points are near it."""
UNDECIDED = "undecided"
"""It is one of several."""
CONTRADICTED = "contradicted"
"""Other poses explain the points, and it does not."""
UNEXPLAINED = "nothing fits"
"""No pose explains them."""
_INLIER = 0.005  # m


@dataclass(frozen=True, eq=False)
class PoseJudgement:
    """What points say of a pose."""

    verdict: str  # CONFIRMED, UNDECIDED, CONTRADICTED or UNEXPLAINED
    above: float  # nats by which it explains the points worse than the best pose that was found
    inliers: float  # share of the known points within 5 mm of what they should be
    # (K, 4, 4): poses that explain the points as well, the likeliest first.
    world_from_object: FloatArray
    apart: FloatArray  # (K,), root mean square distance of their surfaces from the pose's, metres
    others: int  # how many of these are no neighbours of the pose

    @property
    def farthest(self) -> float:
        """Distance of the farthest pose that explains as much, metres."""
        return float(self.apart.max())

    def __str__(self) -> str:
        far = f"poses up to {1000.0 * self.farthest:.1f} mm off explain as much"
        return (
            f"{self.verdict} ({self.above:.1f} nats above the best, {100.0 * self.inliers:.0f} % "
            f"of the points within 5 mm; {far})"
        )


def judged_pose(
    method: Method,
    problem: RegistrationProblem,
    *,
    hypotheses: Hypotheses,
    world_from_object: FloatArray,
) -> PoseJudgement:
    """Return what the points of a problem say of a pose (4, 4).

    hypotheses: of the problem, by the method, with trust. A pose is contradicted where it explains
    the points worse than the best hypothesis by more than 9 nats, though errors that points may
    share cost nothing (`Anchored.holds`), and confirmed where the verdict on the hypotheses is
    determined, and their pose a neighbour of this one: no further than the width of a mode, with a
    centre and a turn no further than `sure_within` and SURE_TURN.
    """
    trust = hypotheses.trust
    assert trust is not None
    noise = noise_of(method)
    carried = problem.carried(hypotheses.push_distance)
    pose = Poses.of(inverse(world_from_object)[None])
    search = method if isinstance(method, Anchored) else search_for(noise)
    holds = bool(search.holds(problem, hypotheses, pose.matrices)[0])
    likely, _ = explaining(carried, hypotheses, sensor_noise=noise)
    energies = pose_energies(carried, Poses.joined([pose, likely]), noise=noise_model(noise))
    apart = distances_apart_from(carried.sdf, likely, other=pose)
    both = Poses.joined([pose, likely])
    every = np.ones((len(both), len(both)), dtype=bool)
    differ = turned(carried.sdf, both, pairs=every, more_than=SURE_TURN)[0, 1:]
    centres = apply(both.world_from_object, middle(carried.sdf)[None])[:, 0]
    away = np.sqrt(((centres[1:] - centres[0]) ** 2).sum(axis=1)) > sure_within(carried.sdf, noise)
    others = (apart > mode_width(carried.sdf, noise)) | differ | away
    points = carried.points
    off = np.abs(signed_distances(carried.sdf, pose, points=points.known)[0] - points.sdf)
    if trust.verdict == NOTHING:
        verdict = UNEXPLAINED
    elif not holds:
        verdict = CONTRADICTED
    elif trust.verdict == DETERMINED and not others[0]:
        verdict = CONFIRMED
    else:
        verdict = UNDECIDED
    return PoseJudgement(
        verdict,
        above=float(energies[0] - energies[1:].min()),
        inliers=float((off <= _INLIER).mean()) if len(off) else 0.0,
        world_from_object=likely.world_from_object,
        apart=apart,
        others=int(others.sum()),
    )
