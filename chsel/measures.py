"""The measures whose diversity quality-diversity search seeks (CHSEL, Sec. IV-C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import SettingError, require_choice
from chsel.kernels.elementary import arctangents, logs, sines_cosines
from chsel.kernels.measures import (
    OBJECT_POSITION,
    OBJECT_YAW,
    TRANSLATION,
    VECTOR,
    MeasureCode,
)


@dataclass(frozen=True)
class Measure:
    """A map from search vectors to k numbers: axes names them with units.

    code: how it is computed. A circular measure is an angle in radians.
    """

    axes: tuple[str, ...]
    code: MeasureCode
    circular: bool = False

    @property
    def count(self) -> int:
        """k."""
        return len(self.axes)

    def moments(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and population standard deviation (k,) of values (B, k), on the circle if circular.

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
    """The measure of that name, or SettingError if it does not exist in this search space."""
    require_choice("measure", name, MEASURES)
    refused, wanted = (_SE3_ONLY, "without plane") if planar else (_SE2_ONLY, "with plane")
    if name in refused:
        fitting = sorted({**_ANY, **(_SE2_ONLY if planar else _SE3_ONLY)})
        raise SettingError(f"measure {name} exists only {wanted}; accepted: {', '.join(fitting)}")
    return MEASURES[name]
