"""The choice of hypotheses for the least expected plausible diversity: stage 6 of docs/anchored.md.

Candidates are drawn from the likelihood, so each of them may be the true pose, all alike. With the
i-th one of N true, the plausible set is P_i, those at most `reach` nats less likely than it. The
plausible diversity (Sec. V of the paper) of B hypotheses H to P_i is

    mean_{j in P_i} min_{h in H} d_jh^2  +  mean_{h in H} min_{j in P_i} d_hj^2,

and its mean over i is

    sum_j w_j min_{h in H} d_jh^2  +  sum_{h in H} p_h,
    w_j = 1/N sum_{i: j in P_i} 1 / |P_i|,      p_h = 1/(N B) sum_i min_{j in P_i} d_hj^2 :

facility location, where serving the candidate j from h costs w_j d_jh^2, and opening h costs p_h.
"""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray, evenly_spaced
from chsel.problem.basins import basin_bests
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.subset import facilities, squared_distances
from chsel.problem.surface import in_order
from chsel.qd.selection import repeated

_LIKELY_MODE = 3.0  # nats above the best pose of all: 20 times less likely


def chosen_hypotheses(
    sdf: SdfGrid,
    poses: Poses,
    *,
    energies: FloatArray,
    count: int,
    modes: int,
    reach: float,
    most: int,
) -> IntArray:
    """Return indices of at most `count` candidates, whose energies (N,), nats, ascend.

    First come the best of the likeliest modes, at most `modes`, then one after another those that
    lower the expected plausible diversity the most. reach: nats. most: candidates that are looked
    at, evenly from the lowest energy to the highest.
    """
    likely = int((energies <= energies.min() + _LIKELY_MODE).sum())
    bests = basin_bests(sdf, poses[:likely], most=min(modes, count))
    pool = np.union1d(bests, evenly_spaced(len(energies), most))
    squared = squared_distances(sdf, poses[pool])
    weights, prices = weights_and_prices(squared, energies[pool], reach=reach, count=count)
    first = np.searchsorted(pool, bests)
    return pool[facilities(weights[:, None] * squared, first, count=count, prices=prices)]


def filled_up(poses: Poses, chosen: IntArray, *, count: int) -> IntArray:
    """Return `count` indices of poses: those chosen, distinct others evenly, then copies of all.

    Fewer than `count` are chosen where others have the same surface as chosen ones.
    """
    if len(chosen) >= count:
        return chosen
    others = np.setdiff1d(np.arange(len(poses)), chosen)
    new = ~repeated(poses[np.concatenate([chosen, others])])
    others = others[new[len(chosen) :]]
    others = others[evenly_spaced(len(others), count - len(chosen))]
    return np.resize(np.concatenate([chosen, others]), count)


def weights_and_prices(
    squared: FloatArray, energies: FloatArray, *, reach: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return the weights w (N,) and prices p (N,), m^2, of candidates whose energies (N,) ascend.

    squared (N, N): d^2, m^2. count: hypotheses, B.
    """
    total = len(energies)
    sizes = np.searchsorted(energies, energies + reach, side="right")  # P_i: the first |P_i|
    shares = np.bincount(sizes - 1, 1.0 / sizes, total)  # of 1 / |P_i|, by the last in P_i
    weights = np.cumsum(shares[::-1])[::-1] / total
    to_plausible = np.minimum.accumulate(squared, axis=1)[:, sizes - 1]  # (h, i)
    return weights, in_order(to_plausible) / (total * count)
