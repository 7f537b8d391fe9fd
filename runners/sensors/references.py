"""What an untouched membrane looks like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.sensing.depth_camera import PinholeCamera, valid_pixels
from runners.sensors.depth_source import metres
from runners.sensors.image_file import read_image
from runners.sensors.rig import BubbleRig


def membrane_reference(
    rig: BubbleRig, samples: list[np.ndarray], camera: PinholeCamera, beside: Path
) -> FloatArray:
    """Depth (H, W) of a pad's untouched membrane, metres, 0 where it is not known.

    By the rig's file, relative to the folder `beside` unless it is found as it stands; or the
    median of images (H, W). Raises SessionError if there are none, or of another size.
    """
    if rig.reference is not None:
        path = Path(rig.reference).expanduser()
        if not path.is_absolute() and not path.is_file():
            path = beside / path
        images = [read_image(path, f"reference of {rig.name}")]
    elif rig.kind == "deformation":
        raise SessionError(
            f"{rig.name} has images of deformation and no reference; accepted: reference=FILE, the "
            "depth of its untouched membrane"
        )
    else:
        images = samples
    if not images:
        raise SessionError(
            f"{rig.name} has no image before the first probe to be its reference; accepted: "
            "reference=FILE, or a log that begins before its first probe"
        )
    shape = (camera.height, camera.width)
    for image in images:
        if image.shape != shape:
            height, width = image.shape
            raise SessionError(
                f"the reference of {rig.name} has {width} x {height} pixels; accepted: those of "
                f"its camera, {shape[1]} x {shape[0]}"
            )
    depths = np.stack([metres(image, rig.unit) for image in images])
    known = valid_pixels(depths, nearest=rig.range[0], furthest=rig.range[1])
    often = known.mean(axis=0) > 0.5
    if not often.any():
        raise SessionError(
            f"the reference of {rig.name} has no depth between {rig.range[0]:g} and "
            f"{rig.range[1]:g} m (its range)"
        )
    middle = np.ma.median(np.ma.masked_array(depths, ~known), axis=0)
    return np.where(often, np.ma.filled(middle, 0.0), 0.0)
