"""From fields that messages of all encodings share to what they contain, checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray
from replay.mcap.texts import one_line
from runners.sensors.log.messages import (
    CloudMessage,
    Decode,
    Decoded,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    TransformMessage,
    UnusableMessage,
)

_NANOSECONDS = 10**9
_END_OF_TIME = 2**63
_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame
_FLOATS = {7: "f4", 8: "f8"}  # in sensor_msgs/PointField and foxglove.PackedElementField alike
_AXES = ("x", "y", "z")


def decoder(
    name: str, parse: Callable[[bytes], Any], contents: Callable[[Any], Iterator[Decoded]]
) -> Decode:
    """Decodes messages of this name. parse: of a library, which may raise anything."""

    def decode(data: bytes) -> Iterator[Decoded]:
        try:
            yield from contents(parse(data))
        except UnusableMessage:
            raise
        except Exception as error:
            reason = one_line(f"{type(error).__name__}: {error}")[:200]
            raise UnusableMessage(f"a message is not a valid {name} ({reason})") from None

    return decode


def stamp_of(seconds: int, nanoseconds: int) -> int | None:
    """A time in nanoseconds; None for 0, which says that there is none."""
    stamp = seconds * _NANOSECONDS + nanoseconds
    if not 0 <= stamp < _END_OF_TIME:
        raise UnusableMessage("its time stamp is no time")
    return stamp or None


def frame_name(name: str) -> str:
    """The name of a frame without the slash that old programs put ahead."""
    return one_line(name.removeprefix("/"))


def rigid(position: Any, quaternion: Any) -> FloatArray:
    """The transform (4, 4) of a position x, y, z, metres, and a quaternion of any length.

    Raises UnusableMessage for a quaternion of length 0 and for numbers that are not finite.
    """
    numbers = x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    place = position.x, position.y, position.z
    largest = max(map(abs, numbers))
    if not largest > 0.0 or not all(map(math.isfinite, numbers)):
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
    parent, child = frame_name(parent), frame_name(child)
    if not parent or not child:
        return UnusableMessage("a transform lacks the name of a frame")
    try:
        return TransformMessage(parent, child, rigid(position, quaternion))
    except UnusableMessage as error:
        return error


def pose(message: Any, frame: str) -> PoseMessage:
    """A pose of both encodings."""
    return PoseMessage(frame, rigid(message.pose.position, message.pose.orientation))


def poses(message: Any, frame: str) -> CloudMessage:
    """Places of poses of both encodings."""
    return CloudMessage(frame, positions(one.position for one in message.poses))


def point(message: Any, frame: str) -> CloudMessage:
    """A single point of both encodings."""
    return CloudMessage(frame, positions([message.point]))


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


def positions(points: Iterable[Any]) -> FloatArray:
    """Points (N, 3) of objects that have x, y and z."""
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)


def packed_points(
    data: bytes,
    fields: Mapping[str, tuple[int, int]],
    stride: int,
    *,
    size: tuple[int, int],
    row: int,
    big_endian: bool = False,
) -> FloatArray:
    """Points (N, 3) of `stride` bytes each; size: points a row, and rows of `row` bytes.

    fields: offset in bytes and type by name.
    """
    (width, rows), order = size, ">" if big_endian else "<"
    for axis in _AXES:
        if axis not in fields or fields[axis][1] not in _FLOATS:
            raise UnusableMessage(f"a point cloud has no field {axis} of float32 or float64")
    if row * rows != len(data) or width * stride > row:
        raise UnusableMessage(
            f"a point cloud of {width} x {rows} points of {stride} bytes in rows of {row} bytes "
            f"cannot have {len(data)} bytes"
        )
    if not data:
        return np.zeros((0, 3))
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
