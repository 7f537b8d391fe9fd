#!/usr/bin/env bash
# rosbags 0.11.9: a ROS 1 bag carries the definition of its messages, in which std_msgs/Header has
# `uint32 seq`. A typestore of just these definitions reads the messages (deserialize_ros1), but its
# ros1_to_cdr fails on every message with a header: the conversion skips the number by itself and
# expects types without it, as those of ROS 2 stores are. Without the field it works.
# Seen: SerdeError "Invalid string length" with the definitions as they stand in the bag.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'PYTHON'
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

noetic = get_typestore(Stores.ROS1_NOETIC)
kind, header = "geometry_msgs/msg/PointStamped", "std_msgs/msg/Header"
time = noetic.types["builtin_interfaces/msg/Time"](7, 5)
point = noetic.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
sent = noetic.types[kind](noetic.types[header](3, time, "camera"), point)
with Writer("log.bag") as writer:
    connection = writer.add_connection("/point", kind, typestore=noetic)
    writer.write(connection, 7, noetic.serialize_ros1(sent, kind))
with Reader("log.bag") as reader:
    ((connection, _, data),) = reader.messages()
    types = get_types_from_msg(connection.msgdef.data, kind)
own = get_typestore(Stores.EMPTY)
own.register(types)
read = own.deserialize_ros1(data, kind)
print("deserialize_ros1: frame", read.header.frame_id, "seq", read.header.seq)
try:
    own.ros1_to_cdr(data, kind)
    refusal = ""
except Exception as error:
    refusal = f"{type(error).__name__}: {error}"
print("ros1_to_cdr with seq in the types:", refusal or "converts")
constants, fields = types[header]
types[header] = (constants, [field for field in fields if field[0] != "seq"])
without = get_typestore(Stores.EMPTY)
without.register(types)
converted = without.deserialize_cdr(without.ros1_to_cdr(data, kind), kind)
print("without it: frame", converted.header.frame_id, "x", converted.point.x)
assert read.header.seq == 3
assert "Invalid string length" in refusal
assert (converted.header.frame_id, converted.point.x) == ("camera", 1.0)
PYTHON
