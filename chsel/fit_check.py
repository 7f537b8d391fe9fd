"""Whether the best hypothesis explains the known points."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import PointsWarning
from chsel.pose import apply
from chsel.problem import Hypotheses, RegistrationProblem

MOST_OFF = 0.04  # object diameters by which known points are off on average
MOST_NOISE = 10.0  # noise levels that a lowest energy can have


def check_fit(
    problem: RegistrationProblem, hypotheses: Hypotheses, noise: float | None = None
) -> list[PointsWarning]:
    """A warning if the best hypothesis contradicts the points by more than inexact sensors can.

    What it leaves, by the SDF and whatever the method's cost is: the distance between known points
    and their level, the depth of free points in the object, the height of occupied ones above it.
    noise: of known points by the method's settings, metres, if its costs are energies in metres.
    """
    sdf, points, best = problem.sdf, problem.points, hypotheses.object_from_world[0]

    def signed(of: FloatArray) -> FloatArray:
        value: FloatArray = sdf.query(apply(best, of), lookup="trilinear")[0].numpy()
        return value

    tolerance = max(MOST_OFF * sdf.diameter, sdf.resolution)
    off = np.abs(signed(points.known) - points.sdf)
    depth = float(-signed(points.free).min(initial=0.0))
    height = float(signed(points.occupied).max(initial=0.0))
    found = []
    if len(off) and off.mean() > tolerance:
        mean, most = _length(float(off.mean())), _length(float(off.max()))
        found.append(f"known points are {mean} off on average (up to {most})")
    if depth > tolerance + problem.free_resolution:
        found.append(f"free points are up to {_length(depth)} inside")
    if height > tolerance + problem.free_resolution:
        found.append(f"occupied points are up to {_length(height)} outside")
    if found:
        text = (
            f"no hypothesis explains the points: at the best, {', '.join(found)}; check units, "
            "frames, and the object and its scale"
        )
        return [PointsWarning("no_fit", text)]
    energy = float(hypotheses.cost[0])
    if noise is None or energy <= MOST_NOISE * noise:
        return []
    text = (
        f"the lowest energy is {_length(energy)}, {energy / noise:.0f} noise levels: no hypothesis "
        f"explains the points, or sensors are less exact than the method's noise of {noise:g} m"
    )
    return [PointsWarning("above_noise", text)]


def _length(metres: float) -> str:
    return f"{1000.0 * metres:.3g} mm" if metres < 1.0 else f"{metres:.3g} m"
