"""Bags of ROS 1, as docs/robot_logs.md says: converted by the package rosbags, installed aside."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.messages import CameraInfoMessage
from runners.sensors.log.raw_log import RawLog

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[4] / "docs" / "robot_logs.md"
WRITE = """
import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS1_NOETIC)
name, image = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image"
time = store.types["builtin_interfaces/msg/Time"](sec=7, nanosec=5)
header = store.types["std_msgs/msg/Header"](seq=3, stamp=time, frame_id="cam")
region = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
k, p = np.array([4.0, 0, 2, 0, 4, 1, 0, 0, 1]), np.array([3.0, 0, 2, 0, 0, 3, 1, 0, 0, 0, 1, 0])
d, r = np.zeros(5), np.eye(3).ravel()
info = store.types[name](header, 3, 5, "plumb_bob", d, k, r, p, 0, 0, region)
depth = store.types[image](header, 3, 5, "16UC1", 0, 10, np.arange(30, dtype=np.uint8))
with Writer("LOG.bag") as writer:
    for topic, kind, message in (("/info", name, info), ("/depth", image, depth)):
        number = writer.add_connection(topic, kind, typestore=store)
        writer.write(number, 7 * 10**9, store.serialize_ros1(message, kind))
"""


def test_a_bag_is_converted_as_the_page_says(tmp_path):
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", "site", "rosbags"]
    done = subprocess.run(install, cwd=tmp_path, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"rosbags cannot be installed: {done.stderr.strip()[-200:]}")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    run = {"cwd": tmp_path, "env": environment, "check": True}
    subprocess.run([sys.executable, "-c", WRITE], **run)
    command = re.search(r"^ *(rosbags-convert .*)$", PAGE.read_text(), re.MULTILINE)
    program, *arguments = shlex.split(command[1])
    subprocess.run([sys.executable, tmp_path / "site" / "bin" / program, *arguments], **run)
    log = RawLog(tmp_path / "LOG")
    content = {received.topic: received.content for received in log.messages(log.topics)}
    assert not log.faults
    one, other = (PinholeCamera(5, 3, fx=f, fy=f, cx=2.0, cy=1.0) for f in (4.0, 3.0))
    assert content["/info"] == CameraInfoMessage(one, rectified=other)
    values = np.arange(30, dtype=np.uint8).view("<u2").reshape(3, 5)
    np.testing.assert_array_equal(content["/depth"].values, values)
