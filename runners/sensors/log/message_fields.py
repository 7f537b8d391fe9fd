"""From fields that messages of all encodings share to what they contain, checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray
from replay.mcap.texts import LONGEST_NAME, one_line
from runners.sensors.log.messages import (
    CameraInfoMessage,
    JointsMessage,
    MarkerMessage,
    TransformMessage,
    UnusableMessage,
)

MOST_POINTS = 2**25
_NANOSECONDS = 10**9
_END_OF_TIME = 2**63
_MOST_PIXELS_A_SIDE = 2**16
_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame
_FLOATS = {7: "f4", 8: "f8"}  # in sensor_msgs/PointField and foxglove.PackedElementField alike
_AXES = ("x", "y", "z")

Field = tuple[int, int]  # offset in bytes, type


def stamp_of(seconds: int, nanoseconds: int) -> int | None:
    """A time in nanoseconds; None for 0, which says that there is none."""
    stamp = seconds * _NANOSECONDS + nanoseconds
    if not 0 <= stamp < _END_OF_TIME:
        raise UnusableMessage("its time stamp is no time")
    return stamp or None


@lru_cache(maxsize=1024)  # transforms repeat them hundreds of times a second
def frame_name(name: str, *, needed: bool = False) -> str:
    """The name of a frame without the slash that old programs put ahead."""
    name = name.removeprefix("/")
    if needed and not name:
        raise UnusableMessage("a transform lacks the name of a frame")
    if len(name) > LONGEST_NAME or one_line(name) != name:
        raise UnusableMessage("the name of a frame is too long or is not one line of text")
    return name


def rigid(position: Any, quaternion: Any) -> FloatArray:
    """The transform (4, 4) of a position x, y, z, metres, and a quaternion of any length.

    Raises UnusableMessage for a quaternion of length 0 and for numbers that are not finite.
    """
    numbers = x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    place = position.x, position.y, position.z
    largest = max(abs(x), abs(y), abs(z), abs(w))
    if not 0.0 < largest < math.inf or x != x or y != y or z != z or w != w:
        raise UnusableMessage(f"its quaternion is {_shown(numbers)}")
    if not all(abs(value) < _FURTHEST for value in place):
        raise UnusableMessage(f"its position is {_shown(place)}")
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    s = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), place[0]],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), place[1]],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), place[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def transform(
    parent: str, child: str, position: Any, quaternion: Any
) -> TransformMessage | UnusableMessage:
    """A transform, or what is wrong with it, as others of its message may be right."""
    try:
        return TransformMessage(
            frame_name(parent, needed=True),
            frame_name(child, needed=True),
            rigid(position, quaternion),
        )
    except UnusableMessage as error:
        return error


def intrinsics(
    frame: str,
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    distortion: Sequence[float],
) -> CameraInfoMessage:
    """Intrinsics; UnusableMessage for those that are none, as of a camera without calibration."""
    numbers = (*focal, *centre, *distortion)
    if not all(map(math.isfinite, numbers)) or min(focal) <= 0.0:
        raise UnusableMessage(
            f"a camera's focal lengths are {focal[0]:.3g} and {focal[1]:.3g}, its centre "
            f"{centre[0]:.3g}, {centre[1]:.3g}; accepted: finite, lengths above 0"
        )
    if not all(0 < side <= _MOST_PIXELS_A_SIDE for side in size):
        raise UnusableMessage(f"a camera has {size[0]} x {size[1]} pixels")
    return CameraInfoMessage(frame, *size, *focal, *centre, distorted=any(distortion))


def joints(positions: Iterable[tuple[str, float]]) -> JointsMessage:
    """Positions by name; UnusableMessage if one is not finite."""
    found = {one_line(name): float(position) for name, position in positions}
    for name, position in found.items():
        if not math.isfinite(position):
            raise UnusableMessage(f"joint {name} is at {position}")
    return JointsMessage(found)


def marker(text: str) -> MarkerMessage:
    """A text on one line, of bounded length."""
    return MarkerMessage(one_line(text))


def require_length(what: str, have: int, others: str, want: int) -> None:
    """Raise UnusableMessage unless two lists are as long as one another."""
    if have != want:
        raise UnusableMessage(f"it has {have} {what} for {want} {others}")


def positions(points: Iterable[Any]) -> FloatArray:
    """Points (N, 3) of objects that have x, y and z."""
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)


def named_fields(fields: Iterable[tuple[str, int, int]]) -> dict[str, Field]:
    """Offset and type of x, y and z from names, offsets and types."""
    found = {name: (offset, kind) for name, offset, kind in fields if name in _AXES}
    for axis in _AXES:
        if axis not in found:
            raise UnusableMessage(f"a point cloud lacks the field {axis}")
        if found[axis][1] not in _FLOATS:
            raise UnusableMessage(f"the field {axis} of a point cloud is no float32 or float64")
    return found


def packed_points(
    data: bytes,
    fields: Mapping[str, Field],
    stride: int,
    *,
    size: tuple[int, int],
    row: int,
    big_endian: bool = False,
) -> FloatArray:
    """Points (N, 3) of `stride` bytes each; size: points a row, and rows of `row` bytes."""
    width, rows = size
    ends = [offset + np.dtype(_FLOATS[kind]).itemsize for offset, kind in fields.values()]
    if min(offset for offset, _ in fields.values()) < 0 or max(ends) > stride:
        raise UnusableMessage(f"a field of a point cloud lies out of its {stride} bytes a point")
    if row * rows != len(data) or width * stride > row or width * rows > MOST_POINTS:
        raise UnusableMessage(
            f"a point cloud of {width} x {rows} points of {stride} bytes in rows of {row} bytes "
            f"cannot have {len(data)} bytes"
        )
    if not data:
        return np.zeros((0, 3))
    order = ">" if big_endian else "<"
    layout = np.dtype(
        {
            "names": list(_AXES),
            "formats": [order + _FLOATS[fields[axis][1]] for axis in _AXES],
            "offsets": [fields[axis][0] for axis in _AXES],
            "itemsize": stride,
        }
    )
    lines = np.frombuffer(data, np.uint8).reshape(rows, row)[:, : width * stride]
    points = np.ascontiguousarray(lines).reshape(-1).view(layout)
    return np.stack([points[axis].astype(np.float64) for axis in _AXES], axis=1)


def _shown(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)
