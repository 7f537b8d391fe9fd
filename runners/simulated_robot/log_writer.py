"""A log as a robot's recorder writes it: ROS 2 messages in the order of their arrival."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from mcap.records import Schema
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.ros2_definitions import full_definition

_SECOND = 1_000_000_000  # ns


class LogWriter:
    """Writes an MCAP file. Times are nanoseconds; log times must be after the latest `flush`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._schemas: dict[str, Schema] = {}
        self._counts: Counter[str] = Counter()
        self._waiting: list[tuple[int, int, str, str, Mapping[str, Any], int]] = []
        self._messages = 0

    def add(
        self, topic: str, kind: str, *, message: Mapping[str, Any], stamp: int, log_time: int
    ) -> None:
        """Add a message of a type of DEFINITIONS, sent at `stamp` and received at `log_time`."""
        self._messages += 1
        heapq.heappush(self._waiting, (log_time, self._messages, topic, kind, message, stamp))

    def flush(self, now: int) -> None:
        """Write what was received until now."""
        while self._waiting and self._waiting[0][0] <= now:
            log_time, _, topic, kind, message, stamp = heapq.heappop(self._waiting)
            if kind not in self._schemas:
                name = kind.replace("/", "/msg/")
                self._schemas[kind] = self._writer.register_msgdef(name, full_definition(kind))
            self._counts[topic] += 1
            self._writer.write_message(
                topic, self._schemas[kind], message, log_time, stamp, self._counts[topic]
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with self._file:
            self.flush(2**63)
            self._writer.finish()


def header(frame: str, stamp: int) -> dict[str, Any]:
    """Return a std_msgs/Header."""
    sec, nanosec = divmod(stamp, _SECOND)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def transform(
    parent: str, child: str, *, parent_from_child: FloatArray, stamp: int
) -> dict[str, Any]:
    """Return a geometry_msgs/TransformStamped of a pose (4, 4)."""
    quaternion = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat()
    return {
        "header": header(parent, stamp),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
        },
    }


def image(frame: str, values: np.ndarray, *, stamp: int) -> dict[str, Any]:
    """Return a sensor_msgs/Image of depths (H, W): uint16 or float32."""
    height, width = values.shape
    return {
        "header": header(frame, stamp),
        "height": height,
        "width": width,
        "encoding": "16UC1" if values.dtype == np.uint16 else "32FC1",
        "is_bigendian": 0,
        "step": width * values.dtype.itemsize,
        "data": values.astype(values.dtype.newbyteorder("<")).tobytes(),
    }


def camera_info(frame: str, camera: PinholeCamera, *, stamp: int) -> dict[str, Any]:
    """Return a sensor_msgs/CameraInfo of a camera without distortion."""
    cx, cy, fx, fy = camera.cx, camera.cy, camera.fx, camera.fy
    return {
        "header": header(frame, stamp),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel().tolist(),
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def joint_state(names: Sequence[str], positions: Sequence[float], *, stamp: int) -> dict[str, Any]:
    """Return a sensor_msgs/JointState."""
    return {"header": header("", stamp), "name": names, "position": positions}
