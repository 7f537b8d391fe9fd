"""Members of the plausible set off its grid, around the members that are known."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.evaluation.evaluation_cost import EvaluationCost
from chsel.far_apart import far_apart
from chsel.pose import compose, inverse, product, rotation_vector
from chsel.streams import Purpose, StreamKey, normals, uniforms

_ROUNDS, _MOST_ROUNDS = 8, 64  # the latter where the former find fewer than wanted
_DRAWN = 4000  # poses a round
_ENOUGH = 20  # times as many as wanted, to choose from
_POSITION, _ANGLE = 0.01, 0.1  # standard deviations at first, metres and radians
_SHRINK = 0.5
_LEAST_SCALE = _SHRINK ** (_ROUNDS - 1)
_FEW = 0.02  # members among those drawn, of which a later round makes steps shorter


def local_members(
    cost: EvaluationCost,
    members: FloatArray,
    limit: float,
    wanted: int,
    *,
    lever: float,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Up to `wanted` poses (W, 4, 4) near members (P, 4, 4), world_from_object, and their costs.

    Rounds of normal steps in position and rotation vector from members, those found in earlier
    rounds among them, so that the search walks along the set; the steps get shorter after a round
    that found nothing, and in a thin set, where the first rounds find too few, after one that
    found little. Of all found that cost less than the limit, those are taken that are the
    farthest from each other and from the members; `lever`: metres that a radian counts for. They
    say how far the set reaches around its known members, not where else it has any.
    """
    known, pool, costs, scale = len(members), members, np.zeros(0), 1.0
    for n in range(_MOST_ROUNDS):
        if n == _ROUNDS and len(costs) >= wanted:
            break
        stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, 2 + n)
        steps = normals(stream, (_DRAWN, 6)) * scale
        starts = pool[np.floor(uniforms(stream, 0.0, float(len(pool)), _DRAWN)).astype(int)]
        turned = product(rotation_vector(_ANGLE * steps[:, 3:]), starts[:, :3, :3])
        drawn = compose(turned, starts[:, :3, 3] + _POSITION * steps[:, :3])
        drawn_costs = cost.evaluate(inverse(drawn), limit=limit)
        good = drawn_costs < limit
        pool = np.concatenate([pool, drawn[good]])
        costs = np.concatenate([costs, drawn_costs[good]])
        few = _FEW * _DRAWN if n >= _ROUNDS - 1 else 1
        scale = scale if good.sum() >= few else max(_SHRINK * scale, _LEAST_SCALE)
        if n >= _ROUNDS // 2 and len(costs) >= _ENOUGH * wanted:
            break
    places = np.concatenate([pool[:, :3, 3], lever * pool[:, :3, :3].reshape(-1, 9)], axis=1)
    chosen = np.sort(far_apart(places, known + wanted, given=known))[known:]
    return pool[chosen], costs[chosen - known]
