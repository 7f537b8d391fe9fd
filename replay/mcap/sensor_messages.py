"""The rig and the images of its sensors as the values of messages, both ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard

from chsel.errors import RecordingError
from replay.events import RigDescribed, SensorImage
from replay.mcap.encoding import check_message, shared_arguments, shared_values

_LEVEL = 3  # of compression: a higher one takes longer for hardly less
_VALUE = np.dtype("<u2")
_BITS = 8
_PLAUSIBLE_PIXELS = 2**30
_PIXELS_PER_BYTE = 2**11


@dataclass(frozen=True)
class ImagePlace:
    """Where an image of a sensor stands among the events: its pixels are read when they matter."""

    topic = SensorImage.topic

    step: int


def plausible_pixels(file_size: int) -> int:
    """Pixels that all images of a file of some size may have.

    Blank images compress to next to nothing, but take their time to be looked at.
    """
    return _PLAUSIBLE_PIXELS + _PIXELS_PER_BYTE * file_size


def rig_values(event: RigDescribed) -> dict[str, Any]:
    """The message `Rig`."""
    hand = event.hand
    return shared_values("Rig", event) | {
        "hand_vertices": None if hand is None else np.asarray(hand.vertices, np.float64),
        "hand_faces": None if hand is None else np.asarray(hand.faces, np.int32),
    }


def rig_from(values: Mapping[str, Any]) -> RigDescribed:
    """The rig of a message `Rig`."""
    import trimesh

    hand = None
    if values["hand_vertices"] is not None:
        vertices, faces = values["hand_vertices"].copy(), values["hand_faces"].astype(np.int64)
        hand = trimesh.Trimesh(vertices, faces, process=False)
    return RigDescribed(**shared_arguments(RigDescribed, values), hand=hand)


def image_values(event: SensorImage) -> dict[str, Any]:
    """The message `SensorImage`; RecordingError if its pixels are of another type or shape."""
    values, mask = event.values, event.mask
    if values.dtype != np.uint16 or values.ndim != 2:
        raise RecordingError(
            f"an image has values of {values.dtype} {values.shape}; accepted: uint16 (H, W)"
        )
    if mask.dtype != np.bool_ or mask.shape != values.shape:
        raise RecordingError(
            f"the mask of an image is {mask.dtype} {mask.shape}; accepted: bool {values.shape}"
        )
    return shared_values("SensorImage", event) | {
        "height": values.shape[0],
        "width": values.shape[1],
        "values": zstandard.compress(np.ascontiguousarray(values, _VALUE).tobytes(), _LEVEL),
        "mask": zstandard.compress(np.packbits(mask).tobytes(), _LEVEL),
    }


def check_pixels(values: Mapping[str, Any]) -> None:
    """Raise RecordingError unless an image has as many pixels as it says; none is unpacked."""
    for name, size in _sizes(values).items():
        try:
            claimed = zstandard.frame_content_size(values[name])
        except zstandard.ZstdError:
            claimed = -1
        if claimed != size:
            shape = (values["height"], values["width"])
            raise RecordingError(
                f"{name} of an image of {values['sensor']} have {claimed} bytes; "
                f"accepted: {size} for {shape}"
            )


def image_from(values: Mapping[str, Any]) -> SensorImage:
    """The image of a message `SensorImage`; its arrays are read-only.

    Raises RecordingError if it is not as the table accepts it, or its pixels are not as many as it
    says, or cannot be read.
    """
    check_message("SensorImage", values)
    check_pixels(values)
    shape = (values["height"], values["width"])
    pixels = {}
    for name, size in _sizes(values).items():
        try:
            pixels[name] = zstandard.decompress(values[name], max_output_size=size)
        except zstandard.ZstdError as error:
            raise RecordingError(f"{name} of an image cannot be read: {error}") from None
    depths = np.frombuffer(pixels["values"], _VALUE).astype(np.uint16, copy=False)
    bits = np.frombuffer(pixels["mask"], np.uint8)
    mask = np.unpackbits(bits, count=shape[0] * shape[1]).view(np.bool_).reshape(shape)
    mask.setflags(write=False)
    parts = {"values": depths.reshape(shape), "mask": mask}
    return SensorImage(**shared_arguments(SensorImage, values) | parts)


def _sizes(values: Mapping[str, Any]) -> dict[str, int]:
    """Bytes of the pixels, unpacked."""
    count = values["height"] * values["width"]
    return {"values": count * _VALUE.itemsize, "mask": -(-count // _BITS)}
