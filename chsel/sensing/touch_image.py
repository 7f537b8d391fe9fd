"""Images of a touch, as of GelSight, DIGIT and their like: points on the object, and its normals.

Such a sensor looks at a gel from behind and gives, for each pixel, how far the gel is pressed in.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import PointsError, PoseError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, frozen
from chsel.problem.points import FARTHEST_PLACE
from chsel.problem.poses import apply, nearest_rigid, rotated

_PRESSED = 0.0001  # metres: pixels that are pressed in by more are in contact, if no mask says it
_DEEPEST = 0.02  # metres: gels are thinner
_BENT = 0.35  # radians between the planes of two halves of a window: there is an edge between
_LEAST_REACH = 2  # pixels of a window on each side


class TouchPoints(NamedTuple):
    """What a touch says of the object."""

    points: FloatArray  # (M, 3), on the object, world, metres
    normals: FloatArray  # (M, 3), unit, out of the object, world; 0 where one is not known


def touch_points(
    height: Any,
    contact: Any = None,
    *,
    pixel: float,
    world_from_sensor: Any,
    spacing: float = 0.002,
) -> TouchPoints:
    """Return points on the object where a gel is pressed in, about `spacing` metres apart.

    height (H, W): how far the gel is pressed in, metres, not negative where it is in contact.
    contact (H, W): pixels that the object touches; by default those that are pressed in by more
    than 0.1 mm. pixel: metres from one to the next. world_from_sensor (4, 4): of the centre of the
    image on the untouched gel, x along columns, y along rows, z out of the gel. Points go to
    `Session.add(contacts=..., normals=..., normal_noise=...)`.

    A normal is that of the plane nearest to the pixels around, where all of them are in contact and
    no edge is among them. Raises PointsError for images of another shape, without contact, or in
    other units, PoseError for a pose that is not rigid, SettingError for other numbers.
    """
    require_positive("pixel", pixel)
    require_positive("spacing", spacing)
    pose = frozen(
        "world_from_sensor", world_from_sensor, shape=(4, 4), error=PoseError, most=FARTHEST_PLACE
    )
    pose = nearest_rigid("world_from_sensor", pose[None])[0]
    pressed, touched = _checked(height, contact)
    pixels = _spread(touched, max(1, round(spacing / pixel)))
    rows, columns = pixels.T
    middle = 0.5 * (np.array(pressed.shape) - 1.0)
    places = np.stack(
        [
            pixel * (columns - middle[1]),
            pixel * (rows - middle[0]),
            -pressed[rows, columns],
        ],
        axis=1,
    )
    reach = max(_LEAST_REACH, round(0.5 * spacing / pixel))
    normals = _normals(pressed / pixel, touched, reach=reach)[rows, columns]
    return TouchPoints(apply(pose, places), rotated(pose[:3, :3], normals))


def _checked(height: Any, contact: Any) -> tuple[FloatArray, BoolArray]:
    """Return heights (H, W), 0 where there is no contact, and whether there is."""
    pressed = np.asarray(height, dtype=np.float64)
    if pressed.ndim != 2 or pressed.size == 0:
        raise PointsError(f"height has shape {pressed.shape}; accepted: (H, W), of one image")
    if contact is None:
        touched = np.asarray(pressed > _PRESSED)
    else:
        touched = np.asarray(contact)
        if touched.shape != pressed.shape or touched.dtype != np.bool_:
            raise PointsError(
                f"contact has shape {touched.shape} of {touched.dtype}; accepted: {pressed.shape} "
                "of bool, as height"
            )
    if not touched.any():
        raise PointsError("no pixel is in contact; accepted: a touch, or nothing to add")
    values = pressed[touched]
    if not (np.isfinite(values) & (values >= 0.0) & (values <= _DEEPEST)).all():
        raise PointsError(
            f"height is from {values.min():g} to {values.max():g} in contact; accepted: from 0 to "
            f"{_DEEPEST:g} metres, how far the gel is pressed in"
        )
    return np.where(touched, pressed, 0.0), touched


def _spread(touched: BoolArray, side: int) -> IntArray:
    """Return pixels (M, 2) in contact, rows and columns: of each square the most central one."""
    pixels = np.argwhere(touched)
    squares, of_pixel = np.unique(pixels // side, axis=0, return_inverse=True)
    of_pixel = of_pixel.reshape(-1)
    off = ((pixels - side * squares[of_pixel] - 0.5 * (side - 1)) ** 2).sum(axis=1)
    order = np.lexsort((off, of_pixel))
    first = np.flatnonzero(np.diff(of_pixel[order], prepend=-1))
    return pixels[order[first]]


def _normals(heights: FloatArray, touched: BoolArray, *, reach: int) -> FloatArray:
    """Return the object's normals (H, W, 3) in the sensor's frame; 0 where one is not known.

    heights (H, W): in pixels. reach: pixels of the windows of planes, on each side.
    """
    from scipy.ndimage import binary_erosion  # which takes long to import

    steps = np.arange(-reach, reach + 1)
    before, after = steps[: reach + 1], steps[reach:]
    whole = _plane_normal(heights, down=steps, right=steps)
    above = _plane_normal(heights, down=before, right=steps)
    below = _plane_normal(heights, down=after, right=steps)
    left = _plane_normal(heights, down=steps, right=before)
    right = _plane_normal(heights, down=steps, right=after)
    known = binary_erosion(touched, np.ones((2 * reach + 1, 2 * reach + 1), dtype=bool))
    for one, other in ((above, below), (left, right)):
        known &= (one * other).sum(axis=-1) >= math.cos(_BENT)
    return np.where(known[..., None], whole, 0.0)


def _plane_normal(heights: FloatArray, *, down: IntArray, right: IntArray) -> FloatArray:
    """Return normals (H, W, 3) of the planes of least squares through windows around each pixel.

    down, right: steps from the pixel to those of its window, along rows and columns.
    """
    from scipy.ndimage import correlate

    size = int(max(np.abs(down).max(), np.abs(right).max()))
    weights = np.zeros((2, 2 * size + 1, 2 * size + 1))
    places = np.ix_(down + size, right + size)
    weights[0][places] = (right - right.mean()) / (len(down) * right.var() * len(right))
    weights[1][places] = (down - down.mean())[:, None] / (len(right) * down.var() * len(down))
    along_x, along_y = (correlate(heights, weight, mode="nearest") for weight in weights)
    out = np.stack([-along_x, -along_y, np.full(heights.shape, -1.0)], axis=-1)
    return out / np.sqrt((out**2).sum(axis=-1, keepdims=True))
