"""The ROS 2 messages that are read and simulated, and what definitions in files may add."""

from __future__ import annotations

import re

_HEADER = "std_msgs/Header header"
_POSE = "geometry_msgs/Pose pose"

DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "std_msgs/String": "string data",
    "std_msgs/Bool": "bool data",
    **{
        f"std_msgs/{sign}Int{bits}": f"{sign.lower()}int{bits} data"
        for sign in ("", "U")
        for bits in (8, 16, 32, 64)
    },
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation; "
    "geometry_msgs/Quaternion rotation",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": f"{_HEADER}; {_POSE}",
    "geometry_msgs/PoseArray": f"{_HEADER}; geometry_msgs/Pose[] poses",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force; geometry_msgs/Vector3 torque",
    "geometry_msgs/WrenchStamped": f"{_HEADER}; geometry_msgs/Wrench wrench",
    "geometry_msgs/PointStamped": f"{_HEADER}; geometry_msgs/Point point",
    "geometry_msgs/TransformStamped": f"{_HEADER}; string child_frame_id; "
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/JointState": f"{_HEADER}; string[] name; float64[] position; "
    "float64[] velocity; float64[] effort",
    "sensor_msgs/Image": f"{_HEADER}; uint32 height; uint32 width; string encoding; "
    "uint8 is_bigendian; uint32 step; uint8[] data",
    "sensor_msgs/CompressedImage": f"{_HEADER}; string format; uint8[] data",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset; uint32 y_offset; uint32 height; "
    "uint32 width; bool do_rectify",
    "sensor_msgs/CameraInfo": f"{_HEADER}; uint32 height; uint32 width; string distortion_model; "
    "float64[] d; float64[9] k; float64[9] r; float64[12] p; uint32 binning_x; uint32 binning_y; "
    "sensor_msgs/RegionOfInterest roi",
    "sensor_msgs/PointField": "string name; uint32 offset; uint8 datatype; uint32 count",
    "sensor_msgs/PointCloud2": f"{_HEADER}; uint32 height; uint32 width; "
    "sensor_msgs/PointField[] fields; bool is_bigendian; uint32 point_step; uint32 row_step; "
    "uint8[] data; bool is_dense",
}
"""Fields by the name of the message, of which names in files have "/msg" besides."""

Fields = tuple[tuple[str, str], ...]
"""Types and names of the fields of a message, in their order."""

_LONGEST_TEXT = 2**16
_SEPARATOR = "\n" + "=" * 80 + "\n"
_SAME = {"byte": "uint8", "char": "uint8"}
_SCALARS = {"bool", "string", "float32", "float64"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_NAME = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")  # of a field, by ROS 2
_LIMIT = re.compile(r"<=\d+")


def short_name(name: str) -> str:
    """The name of a message as `DEFINITIONS` has it."""
    return name.replace("/msg/", "/")


def full_definition(name: str, fields: Fields | None = None) -> str:
    """The definition of a message with those of all that it contains, as ROS 2 writes them.

    fields: in place of its own.
    """
    fields = _fields(DEFINITIONS[name]) if fields is None else fields
    parts = ["\n".join(f"{kind} {field}" for kind, field in fields)]
    for inner in _nested(fields):
        parts.append(f"MSG: {inner}\n" + DEFINITIONS[inner].replace("; ", "\n"))
    return _SEPARATOR.join(parts) + "\n"


def defined_fields(name: str, text: str) -> Fields | None:
    """The fields of a message by its definition in a file.

    Those of ROS 2 in their order, and among them further numbers and texts. None for others, as an
    array of messages that a file defines could make the decoder run for ever. Of the definition's
    other parts, those of ROS 2 itself are taken in their place, as for a message without a text.
    """
    if len(text) > _LONGEST_TEXT:
        return None
    own = re.split(r"^={3,}\s*$", text, maxsplit=1, flags=re.MULTILINE)[0]
    lines = "; ".join(line.split("#")[0] for line in own.splitlines())
    missing = list(_fields(DEFINITIONS[name]))
    if not lines.strip("; "):
        return tuple(missing)
    fields: list[tuple[str, str]] = []
    for kind, field in map(_normalised, _fields(lines)):
        if missing and (kind, field) == _normalised(missing[0]):
            fields.append(missing.pop(0))
        elif kind in _SCALARS and _NAME.fullmatch(field):
            fields.append((kind, field))
        else:
            return None
    is_readable = not missing and len({field for _, field in fields}) == len(fields)
    return tuple(fields) if is_readable else None


def _nested(fields: Fields) -> list[str]:
    """The messages that fields are made of, each once, in the order of their use."""
    found: dict[str, None] = {}
    for kind, _ in fields:
        inner = kind.partition("[")[0]
        if inner in DEFINITIONS:
            found |= dict.fromkeys([inner, *_nested(_fields(DEFINITIONS[inner]))])
    return list(found)


def _normalised(field: tuple[str, str]) -> tuple[str, str]:
    """A type without package and limit, and a name in small letters: what all texts agree in."""
    base, bracket, size = _LIMIT.sub("", field[0]).rsplit("/", 1)[-1].partition("[")
    return _SAME.get(base, base) + bracket + size, field[1].lower()


def _fields(text: str) -> Fields:
    """Types and names of the fields of a definition without comments; constants are none."""
    parts = [part.split(maxsplit=2) for part in text.split(";")]
    return tuple(
        (words[0], words[1]) for words in parts if len(words) >= 2 and not _is_constant(words)
    )


def _is_constant(words: list[str]) -> bool:
    """Whether type, name and rest of a line are those of NAME=VALUE."""
    return "=" in words[1] or words[-1].startswith("=")
