"""Point clouds as messages carry them: bytes, of which some are x, y and z."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sensors.unusable import UnusableMessage

MOST_POINTS = 2**25
_FLOATS = {7: "f4", 8: "f8"}  # in sensor_msgs/PointField and foxglove.PackedElementField alike
_AXES = ("x", "y", "z")

Field = tuple[int, int]  # offset in bytes, type


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
