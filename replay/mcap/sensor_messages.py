"""The rig and the images of its sensors as the values of messages, both ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard

from chsel.errors import RecordingError
from replay.events import RigDescribed, SensorImage
from replay.mcap.attachments import check_mesh
from replay.mcap.event_checks import check_image_head

_LEVEL = 3  # of compression: a higher one takes longer for hardly less
_VALUE = np.dtype("<u2")
_BITS = 8
_PLAUSIBLE_PIXELS = 2**30
_PIXELS_PER_BYTE = 2**11
_HEAD = ("step", "sensor", "kind", "unit", "intrinsics", "world_from_camera")


@dataclass(frozen=True)
class ImagePlace:
    """Where an image of a sensor stands among the events: its pixels are read when they matter."""

    step: int


def plausible_pixels(file_size: int) -> int:
    """Pixels that all images of a file of some size may have.

    Blank images compress to next to nothing, but take their time to be looked at.
    """
    return _PLAUSIBLE_PIXELS + _PIXELS_PER_BYTE * file_size


def rig_values(event: RigDescribed) -> dict[str, Any]:
    """A rig as the message `Rig` has it, but for its step."""
    hand = event.hand
    return {
        "name": event.name,
        "source": event.source,
        "hand_vertices": None if hand is None else np.asarray(hand.vertices, np.float64),
        "hand_faces": None if hand is None else np.asarray(hand.faces, np.int32),
    }


def rig(values: Mapping[str, Any]) -> RigDescribed:
    """The rig of a message `Rig`. Raises RecordingError if its hand is no mesh."""
    import trimesh

    vertices, faces = values["hand_vertices"], values["hand_faces"]
    if (vertices is None) is not (faces is None):
        raise RecordingError("the hand lacks its vertices or its faces; accepted: both or none")
    hand = None
    if vertices is not None:
        check_mesh(vertices, faces)
        hand = trimesh.Trimesh(vertices.copy(), faces.astype(np.int64), process=False)
    return RigDescribed(values["step"], values["name"], values["source"], hand)


def image_values(event: SensorImage) -> dict[str, Any]:
    """An image as the message `SensorImage` has it, but for its step."""
    height, width = event.values.shape
    return {
        "sensor": event.sensor,
        "kind": event.kind,
        "height": height,
        "width": width,
        "values": _packed(np.ascontiguousarray(event.values, _VALUE).tobytes()),
        "unit": event.unit,
        "mask": _packed(np.packbits(event.mask).tobytes()),
        "intrinsics": event.intrinsics,
        "world_from_camera": event.world_from_camera,
    }


def check_image(values: Mapping[str, Any]) -> None:
    """Raise RecordingError unless a message `SensorImage` is right, as far as seen from outside."""
    shape = (values["height"], values["width"])
    named = ("sensor", "kind", "unit", "intrinsics", "world_from_camera")
    sensor, kind, unit, intrinsics, pose = (values[name] for name in named)
    check_image_head(sensor, kind, shape, unit, intrinsics, pose)
    for name, size in _sizes(values).items():
        try:
            claimed = zstandard.frame_content_size(values[name])
        except zstandard.ZstdError:
            claimed = -1
        if claimed != size:
            raise RecordingError(
                f"{name} of an image of {sensor} have {claimed} bytes; accepted: {size} for {shape}"
            )


def image(values: Mapping[str, Any]) -> SensorImage:
    """The image of a message `SensorImage`; its arrays are read-only.

    Raises RecordingError if its pixels are not as many as it says, or cannot be read.
    """
    check_image(values)
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
    head = {name: values[name] for name in _HEAD}
    return SensorImage(**head, values=depths.reshape(shape), mask=mask)


def _sizes(values: Mapping[str, Any]) -> dict[str, int]:
    """Bytes of the pixels, unpacked."""
    count = values["height"] * values["width"]
    return {"values": count * _VALUE.itemsize, "mask": -(-count // _BITS)}


def _packed(data: bytes) -> bytes:
    packed: bytes = zstandard.compress(data, _LEVEL)
    return packed
