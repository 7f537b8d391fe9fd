"""Messages of ROS 2 as bytes: the fields of their types, schema texts, and the CDR encoding.

Written here, as general encoders go through an image byte by byte: a third of a second each.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

TYPES: dict[str, tuple[str, ...]] = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "std_msgs/String": ("string data",),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation",
        "geometry_msgs/Quaternion rotation",
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/Transform transform",
    ),
    "tf2_msgs/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
    "sensor_msgs/Image": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "string encoding",
        "uint8 is_bigendian",
        "uint32 step",
        "uint8[] data",
    ),
    "sensor_msgs/CompressedImage": ("std_msgs/Header header", "string format", "uint8[] data"),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset",
        "uint32 y_offset",
        "uint32 height",
        "uint32 width",
        "bool do_rectify",
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "string distortion_model",
        "float64[] d",
        "float64[9] k",
        "float64[9] r",
        "float64[12] p",
        "uint32 binning_x",
        "uint32 binning_y",
        "sensor_msgs/RegionOfInterest roi",
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header",
        "string[] name",
        "float64[] position",
        "float64[] velocity",
        "float64[] effort",
    ),
}

_NUMBERS = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float64": "d"}
_HEAD = b"\x00\x01\x00\x00"  # CDR, little-endian


def schema_name(kind: str) -> str:
    """The full name of a type of TYPES: "sensor_msgs/msg/Image" of "sensor_msgs/Image"."""
    package, name = kind.split("/")
    return f"{package}/msg/{name}"


def schema_text(kind: str) -> str:
    """The definition of a type of TYPES, followed by those of all types that it is made of."""
    blocks = ["\n".join(TYPES[kind])]
    blocks += [f"MSG: {part}\n" + "\n".join(TYPES[part]) for part in _parts(kind)]
    return ("\n" + "=" * 80 + "\n").join(blocks) + "\n"


def encode(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message of a type of TYPES as CDR. message: its fields; nested ones are mappings too."""
    body = bytearray()
    _write(body, kind, message)
    return _HEAD + bytes(body)


def _parts(kind: str) -> list[str]:
    """The types that a type is made of, each once, in the order of their use."""
    found: dict[str, None] = {}
    for field in TYPES[kind]:
        part = field.split()[0].partition("[")[0]
        if part in TYPES:
            found[part] = None
            found.update(dict.fromkeys(_parts(part)))
    return list(found)


def _write(body: bytearray, kind: str, value: Any) -> None:
    element, bracket, count = kind.removesuffix("]").partition("[")
    if bracket:
        if not count:
            _pack(body, "I", (len(value),))
        elif len(value) != int(count):
            raise ValueError(f"{kind} has {len(value)} entries")
        if isinstance(value, bytes):
            body += value
        elif element in _NUMBERS:
            _pack(body, _NUMBERS[element], value)
        else:
            for item in value:
                _write(body, element, item)
    elif kind in _NUMBERS:
        _pack(body, _NUMBERS[kind], (value,))
    elif kind == "string":
        text = value.encode() + b"\x00"
        _pack(body, "I", (len(text),))
        body += text
    else:
        for field in TYPES[kind]:
            part, name = field.split()
            _write(body, part, value[name])


def _pack(body: bytearray, code: str, values: Any) -> None:
    """Numbers, aligned to their size; no number takes no room."""
    if len(values):
        body += bytes(-len(body) % struct.calcsize(code))
        body += struct.pack(f"<{len(values)}{code}", *values)
