"""The measures whose diversity quality-diversity search seeks (CHSEL, Sec. IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import SettingError, require_choice
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.elementary import arctangent, arctangents, logs, sines_cosines
from chsel.numerics.pose_tuples import decode, pull_back
from chsel.problem.search_space import SearchSpace

VECTOR, TRANSLATION, OBJECT_POSITION, OBJECT_YAW = range(4)


class MeasureCode(NamedTuple):
    """A measure as kernels take it."""

    kind: int  # VECTOR, TRANSLATION, ...
    size: int  # k
    first: int = 0  # of kind VECTOR: the first entry of the vector that it takes


@leaf
def measures_of(space: Any, measure: Any, vector: Any, out: Any) -> None:
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
def measure_gradients_of(space: Any, measure: Any, vector: Any, out: Any) -> None:
    """Fill out (k, d) with the gradients of the measures by a search vector (d,)."""
    if measure.kind == VECTOR:
        for i in range(measure.size):
            for j in range(len(vector)):
                out[i, j] = 1.0 if j == measure.first + i else 0.0
        return
    r = decode(space, vector)
    none = 0.0
    for i in range(measure.size):
        first = _is(i, 0)
        second = _is(i, 1)
        third = _is(i, 2)
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
def _is(i: Any, j: Any) -> Any:
    return 1.0 if i == j else 0.0


@compiled
def all_measures(space: Any, measure: Any, vectors: Any, out: Any) -> None:
    """Fill out (B, k) with the measures of search vectors (B, d)."""
    for n in range(len(vectors)):
        measures_of(space, measure, vectors[n], out[n])


@compiled
def measure_gradients(space: Any, measure: Any, vector: Any, out: Any) -> None:
    """Fill out (k, d) with the gradients of the measures at one search vector (d,)."""
    measure_gradients_of(space, measure, vector, out)


@dataclass(frozen=True)
class Measure:
    """A map from search vectors to k numbers."""

    axes: tuple[str, ...]  # (k,), names with units
    code: MeasureCode  # for kernels
    circular: bool = False  # an angle in radians

    @property
    def count(self) -> int:
        """k."""
        return len(self.axes)

    def values(self, space: SearchSpace, vectors: FloatArray) -> FloatArray:
        """Return measures (B, k) of search vectors (B, d)."""
        values = np.empty((len(vectors), self.count))
        all_measures(space.arrays, self.code, vectors, values)
        return values

    def gradients(self, space: SearchSpace, vector: FloatArray) -> FloatArray:
        """Return gradients (k, d) of the measures at one search vector (d,)."""
        gradients = np.empty((self.count, len(vector)))
        measure_gradients(space.arrays, self.code, vector, gradients)
        return gradients

    def moments(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and population standard deviation (k,) of values (B, k), also on a circle.

        The circular deviation is sqrt(-2 ln R), R the length of the mean direction.
        """
        if not self.circular:
            return values.mean(axis=0), values.std(axis=0)
        sine, cosine = (part.mean(axis=0) for part in sines_cosines(values))
        length = np.sqrt(sine**2 + cosine**2)
        spread = np.sqrt(-2.0 * logs(np.clip(length, 1e-300, 1.0)))
        return arctangents(sine, cosine), np.where(length > 1.0 - 1e-6, 0.0, spread)


_SE3_ONLY = {
    f"rotation_{count}": Measure(
        tuple(f"6-D rotation {i}" for i in range(count)), MeasureCode(VECTOR, count)
    )
    for count in range(1, 7)
}
_SE2_ONLY = {
    "plane_position": Measure(("u (m)", "v (m)"), MeasureCode(VECTOR, 2, first=1)),
    "plane_angle": Measure(("theta (rad)",), MeasureCode(VECTOR, 1), circular=True),
}
_ANY = {
    "position_2": Measure(("t_x (m)", "t_y (m)"), MeasureCode(TRANSLATION, 2)),
    "position_3": Measure(("t_x (m)", "t_y (m)", "t_z (m)"), MeasureCode(TRANSLATION, 3)),
    "object_xy": Measure(("object x (m)", "object y (m)"), MeasureCode(OBJECT_POSITION, 2)),
    "object_yaw": Measure(("object yaw (rad)",), MeasureCode(OBJECT_YAW, 1), circular=True),
}
MEASURES = {**_ANY, **_SE3_ONLY, **_SE2_ONLY}


def measure_named(name: str, *, planar: bool) -> Measure:
    """Return the measure of that name; SettingError if it does not exist in this search space."""
    require_choice("measure", name, accepted=MEASURES)
    refused, wanted = (_SE3_ONLY, "without plane") if planar else (_SE2_ONLY, "with plane")
    if name in refused:
        fitting = sorted({**_ANY, **(_SE2_ONLY if planar else _SE3_ONLY)})
        raise SettingError(f"measure {name} exists only {wanted}; accepted: {', '.join(fitting)}")
    return MEASURES[name]
