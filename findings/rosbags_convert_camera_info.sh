#!/usr/bin/env bash
# rosbags 0.11.9: rosbags-convert of a ROS 1 bag to MCAP keeps the ROS 1 definition of
# sensor_msgs/CameraInfo, whose fields are called D, K, R and P. ROS 2 allows no capitals in names
# of fields, so a reader of ROS 2 messages refuses the topic, and the camera infos are lost.
# With --dst-typestore ros2_humble the message is that of ROS 2, and is read.
# Seen: mcap-ros2-support 0.6.0 raises "'D' is an invalid field name" on the first file only.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0
cd "$folder"
venv/bin/python - <<'PYTHON'
import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS1_NOETIC)
types = store.types
header = types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](1, 0), "camera")
region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
k = np.array([600.0, 0, 320, 0, 600, 240, 0, 0, 1])
p = np.array([600.0, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0])
kind = "sensor_msgs/msg/CameraInfo"
info = types[kind](header, 480, 640, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region)
with Writer("log.bag") as writer:
    connection = writer.add_connection("/camera_info", kind, typestore=store)
    writer.write(connection, 10**9, store.serialize_ros1(info, kind))
PYTHON
venv/bin/rosbags-convert --src log.bag --dst plain --dst-storage mcap
venv/bin/rosbags-convert --src log.bag --dst humble --dst-storage mcap --dst-typestore ros2_humble
venv/bin/python - <<'PYTHON'
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def first(path):
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return next(reader.iter_decoded_messages())[3]


try:
    first("plain/plain.mcap")
    refusal = ""
except Exception as error:
    refusal = str(error)
print("without --dst-typestore:", refusal or "read")
width = first("humble/humble.mcap").width
print("with --dst-typestore ros2_humble: an image of", width, "columns")
assert "invalid field name" in refusal
assert width == 640
PYTHON
