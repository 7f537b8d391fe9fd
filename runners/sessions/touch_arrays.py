"""Images of touch sensors in an .npz file of points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from chsel.errors import PointsError, PoseError
from chsel.numerics.arrays import FloatArray, IntArray, frozen
from chsel.sensing.touch_image import touch_points

TOUCH_ARRAYS = (
    "touch_height",  # (K, H, W): how far the gel is pressed in, metres
    "touch_pose",  # (K, 4, 4), world_from_sensor, see `chsel.touch_points`
    "touch_pixel",  # metres from one pixel to the next
    "touch_contact",  # (K, H, W), bool; without it pixels that are pressed in by 0.1 mm
    "touch_step",  # (K,), at which each becomes known; without it 0
)


def touched_in(arrays: Mapping[str, Any]) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return points (N, 3), normals (N, 3), 0 if unknown, and steps (N,) of all touch images.

    Raise PointsError, which names the array and the image, for malformed ones.
    """
    missing = [name for name in TOUCH_ARRAYS[:3] if name not in arrays]
    if missing:
        raise PointsError(
            f"{missing[0]} is missing; accepted: {', '.join(TOUCH_ARRAYS[:3])} together"
        )
    heights = frozen("touch_height", arrays["touch_height"], shape=(None, None, None), finite=False)
    count = len(heights)
    poses = frozen("touch_pose", arrays["touch_pose"], shape=(count, 4, 4), error=PoseError)
    (pixel,) = frozen("touch_pixel", np.ravel(arrays["touch_pixel"]), shape=(1,))
    contacts = np.asarray(arrays.get("touch_contact", np.full(count, None)))
    steps = np.asarray(arrays.get("touch_step", np.zeros(count, dtype=np.int64)))
    if len(contacts) != count:
        raise PointsError(f"touch_contact has {len(contacts)} images; accepted: {count}")
    if not np.issubdtype(steps.dtype, np.integer) or steps.shape != (count,):
        raise PointsError(f"touch_step has shape {steps.shape}; accepted: integers, ({count},)")
    points = [np.zeros((0, 3))]
    normals = [np.zeros((0, 3))]
    of_step = [np.zeros(0, dtype=np.int64)]
    for n, (height, pose, contact) in enumerate(zip(heights, poses, contacts, strict=True)):
        try:
            found = touch_points(height, contact, pixel=float(pixel), world_from_sensor=pose)
        except (PointsError, PoseError) as error:
            raise PointsError(f"touch image {n}: {error}") from None
        points.append(found.points)
        normals.append(found.normals)
        of_step.append(np.full(len(found.points), steps[n]))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(of_step)
