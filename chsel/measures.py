"""The measures whose diversity quality-diversity search seeks (CHSEL, Sec. IV-C)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from chsel.arrays import FloatArray
from chsel.errors import SettingError, require_choice

MeasureFunction = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Measure:
    """A map from search vectors to k numbers: axes names them with units.

    Called with vectors (B, d), rotations (B, 3, 3) and translations (B, 3) of object_from_world;
    returns (B, k). A circular measure is an angle in radians.
    """

    axes: tuple[str, ...]
    function: MeasureFunction
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
        sine, cosine = np.sin(values).mean(axis=0), np.cos(values).mean(axis=0)
        length = np.sqrt(sine**2 + cosine**2)
        spread = np.sqrt(-2.0 * np.log(np.clip(length, 1e-300, 1.0)))
        return np.arctan2(sine, cosine), np.where(length > 1.0 - 1e-6, 0.0, spread)

    def unwrapped(self, values: FloatArray, centre: FloatArray) -> FloatArray:
        """Values (B, k) moved by whole turns to within half a turn of the centre (k,)."""
        if not self.circular:
            return values
        turn = 2.0 * math.pi
        return values - turn * np.round((values - centre) / turn)


def _translation(count: int) -> MeasureFunction:
    return lambda vectors, rotation, translation: translation[:, :count]


def _object_position(vectors: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """x and y of p = -R^T t."""
    return -(rotation[:, :, :2] * translation[:, :, None]).sum(dim=1)


def _object_yaw(vectors: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Yaw of R^T about the world's z."""
    return torch.atan2(rotation[:, 0, 1], rotation[:, 0, 0])[:, None]


def _rotation(count: int) -> Measure:
    """The first entries of the 6-D rotation."""
    axes = tuple(f"6-D rotation {i}" for i in range(count))
    return Measure(axes, lambda vectors, rotation, translation: vectors[:, :count])


_SE3_ONLY = {f"rotation_{count}": _rotation(count) for count in range(1, 7)}
_SE2_ONLY = {
    "plane_position": Measure(("u (m)", "v (m)"), lambda x, r, t: x[:, 1:3]),
    "plane_angle": Measure(("theta (rad)",), lambda x, r, t: x[:, 0:1], circular=True),
}
_ANY = {
    "position_2": Measure(("t_x (m)", "t_y (m)"), _translation(2)),
    "position_3": Measure(("t_x (m)", "t_y (m)", "t_z (m)"), _translation(3)),
    "object_xy": Measure(("object x (m)", "object y (m)"), _object_position),
    "object_yaw": Measure(("object yaw (rad)",), _object_yaw, circular=True),
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
