"""A soft-bubble membrane, as the camera inside sees it: a cap that gives way to what presses."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.twin.pinhole import Pinhole

CAP = (0.042, 0.031, 0.022)  # m: semi-axes of the half ellipsoid; x, y, z of its camera
CAP_BASE = 0.055  # m: how far before the camera its rigid base is
THICKNESS = 0.001  # m: how much nearer than its base it can never be pressed
TAUTNESS = 0.003  # m: beside what presses, the dent falls by 1/e over this length
_SWEEPS = 30  # of relaxation, which leave an error of 0.1 %
_MARGIN = 0.025  # m: around what presses, beyond which there is no dent worth a number


class Membrane:
    """rest (H, W): depth of the untouched membrane, metres; beside it is the rigid base."""

    def __init__(self, camera: Pinhole) -> None:
        self.rest = _cap_depth(camera)
        self._most = np.maximum(self.rest - (CAP_BASE + THICKNESS), 0.0)
        pitch = (CAP_BASE + CAP[2]) / camera.focal  # m a pixel
        self._margin = int(np.ceil(_MARGIN / pitch))
        self._kept = 1.0 / (1.0 + (pitch / TAUTNESS) ** 2 / 4.0)

    def pressed(self, beyond: FloatArray) -> FloatArray:
        """Depth (H, W) of the membrane where depth `beyond` (H, W) of what is outside allows.

        The dent w is the least with w >= rest - beyond that elsewhere hangs as a taut sheet on a
        soft bed does, L^2 (w_xx + w_yy) = w with L = TAUTNESS, and ends where the base begins.
        """
        pressing = np.clip(self.rest - beyond, 0.0, self._most)
        if not pressing.any():
            return self.rest
        rows, columns = _around(pressing > 0.0, self._margin)
        least, most = pressing[rows, columns], self._most[rows, columns]
        dent = self._hung(least, most)
        depth = self.rest.copy()
        depth[rows, columns] -= dent
        return depth

    def _hung(self, least: FloatArray, most: FloatArray) -> FloatArray:
        """The dent (h, w) between bounds, by projected successive over-relaxation."""
        over = 2.0 / (1.0 + np.sqrt(1.0 - self._kept**2))
        rows, columns = np.indices(least.shape)
        even = (rows + columns) % 2 == 0
        dent = least
        for half in [even, ~even] * _SWEEPS:
            edged = np.pad(dent, 1)
            around = edged[:-2, 1:-1] + edged[2:, 1:-1] + edged[1:-1, :-2] + edged[1:-1, 2:]
            moved = dent + over * (self._kept / 4.0 * around - dent)
            dent = np.where(half, np.clip(moved, least, most), dent)
        return dent


def _cap_depth(camera: Pinhole) -> FloatArray:
    """Where the ray of every pixel (H, W) leaves the ellipsoid, or else meets the base; metres."""
    x, y = camera.slopes()
    a, b, c = CAP
    # (x s / a)^2 + (y s / b)^2 + ((s - base) / c)^2 = 1, the further of the two depths s
    square = (x / a) ** 2 + (y / b) ** 2 + 1.0 / c**2
    half = CAP_BASE / c**2
    constant = (CAP_BASE / c) ** 2 - 1.0
    inside = half**2 - square * constant
    depth = (half + np.sqrt(np.maximum(inside, 0.0))) / square
    return np.where(inside > 0.0, np.maximum(depth, CAP_BASE), CAP_BASE)


def _around(pixels: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The part of an image that holds these pixels (H, W) and a margin."""
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    return (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
    )
