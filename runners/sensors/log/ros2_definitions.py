"""The ROS 2 messages that are read and simulated."""

from __future__ import annotations

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

_SEPARATOR = "\n" + "=" * 80 + "\n"


def full_definition(name: str) -> str:
    """Return the definition of a message with those of its parts, as ROS 2 writes them."""
    parts = [DEFINITIONS[name].replace("; ", "\n")]
    parts += [f"MSG: {inner}\n" + DEFINITIONS[inner].replace("; ", "\n") for inner in _nested(name)]
    return _SEPARATOR.join(parts) + "\n"


def _nested(name: str) -> list[str]:
    """Return the messages that a message is made of, each once, in the order of their use."""
    found: dict[str, None] = {}
    for field in DEFINITIONS[name].split("; "):
        inner = field.split()[0].partition("[")[0]
        if inner in DEFINITIONS:
            found |= dict.fromkeys([inner, *_nested(inner)])
    return list(found)
