"""The measures of quality-diversity search, and their gradients, one search vector at a time."""

from __future__ import annotations

from typing import NamedTuple

from chsel.kernels.compiler import compiled, leaf
from chsel.kernels.elementary import arctangent
from chsel.kernels.pose import decode, pull_back

VECTOR, TRANSLATION, OBJECT_POSITION, OBJECT_YAW = range(4)


class MeasureCode(NamedTuple):
    """Which measure: its kind, its numbers k, and for kind VECTOR the first entry it takes."""

    kind: int
    size: int
    first: int = 0


@leaf
def measures_of(space, measure, vector, out):  # type: ignore[no-untyped-def]
    """Fill out (k,) with the measures of a search vector (d,)."""
    pose = decode(space, vector)
    if measure.kind == VECTOR:
        for i in range(measure.size):
            out[i] = vector[measure.first + i]
    elif measure.kind == TRANSLATION:
        for i in range(measure.size):
            out[i] = pose[9 + i]
    elif measure.kind == OBJECT_POSITION:  # p = -R^T t
        for i in range(2):
            out[i] = -(pose[i] * pose[9] + pose[3 + i] * pose[10] + pose[6 + i] * pose[11])
    else:  # yaw of R^T about the world's z
        out[0] = arctangent(pose[1], pose[0])


@leaf
def measure_gradients_of(space, measure, vector, out):  # type: ignore[no-untyped-def]
    """Fill out (k, d) with the gradients of the measures by a search vector (d,)."""
    if measure.kind == VECTOR:
        for i in range(measure.size):
            for j in range(len(vector)):
                out[i, j] = 1.0 if j == measure.first + i else 0.0
        return
    r = decode(space, vector)
    none = 0.0
    for i in range(measure.size):
        first, second, third = _is(i, 0), _is(i, 1), _is(i, 2)
        if measure.kind == TRANSLATION:
            by_rotation = (none, none, none, none, none, none, none, none, none)
            by_translation = first, second, third
        elif measure.kind == OBJECT_POSITION:
            a, b, c = -r[9], -r[10], -r[11]
            by_rotation = (
                first * a, second * a, none, first * b, second * b, none,
                first * c, second * c, none,
            )  # fmt: skip
            by_translation = -r[i], -r[3 + i], -r[6 + i]
        else:
            squared = r[0] * r[0] + r[1] * r[1]
            inverse = 1.0 / squared if squared > 0.0 else 0.0
            turn = -r[1] * inverse, r[0] * inverse
            by_rotation = (turn[0], turn[1], none, none, none, none, none, none, none)
            by_translation = none, none, none
        pull_back(space, vector, by_rotation + by_translation, out[i])


@leaf
def _is(i, j):  # type: ignore[no-untyped-def]
    return 1.0 if i == j else 0.0


@compiled
def all_measures(space, measure, vectors, out):  # type: ignore[no-untyped-def]
    """Fill out (B, k) with the measures of search vectors (B, d)."""
    for n in range(len(vectors)):
        measures_of(space, measure, vectors[n], out[n])


@compiled
def measure_gradients(space, measure, vector, out):  # type: ignore[no-untyped-def]
    """Fill out (k, d) with the gradients of the measures at one search vector (d,)."""
    measure_gradients_of(space, measure, vector, out)
