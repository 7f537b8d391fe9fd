"""The messages of the simulated robot, as the fields of ROS 2 types."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.sensing.depth_camera import PinholeCamera

_SECOND = 1_000_000_000  # ns


def header(frame: str, stamp: int) -> dict[str, Any]:
    """A std_msgs/Header."""
    sec, nanosec = divmod(stamp, _SECOND)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def transform(parent: str, child: str, parent_from_child: FloatArray, stamp: int) -> dict[str, Any]:
    """A geometry_msgs/TransformStamped of a pose (4, 4)."""
    return {
        "header": header(parent, stamp),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True)),
            "rotation": dict(
                zip(
                    "xyzw",
                    Rotation.from_matrix(parent_from_child[:3, :3]).as_quat().tolist(),
                    strict=True,
                )
            ),
        },
    }


def image(frame: str, values: np.ndarray, stamp: int) -> dict[str, Any]:
    """A sensor_msgs/Image of depths (H, W): uint16 or float32."""
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


def compressed_image(frame: str, values: np.ndarray, stamp: int) -> dict[str, Any]:
    """A sensor_msgs/CompressedImage of depths (H, W), uint16, as PNG."""
    file = io.BytesIO()
    Image.fromarray(values).save(file, "png", compress_level=3)
    return {
        "header": header(frame, stamp),
        "format": "16UC1; png compressed mono16",
        "data": file.getvalue(),
    }


def camera_info(frame: str, camera: PinholeCamera, stamp: int) -> dict[str, Any]:
    """A sensor_msgs/CameraInfo of a camera without distortion."""
    cx, cy, fx, fy = camera.cx, camera.cy, camera.fx, camera.fy
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width", "do_rectify"), 0)
    return {
        "header": header(frame, stamp),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": region,
    }


def joint_state(names: Sequence[str], positions: Sequence[float], stamp: int) -> dict[str, Any]:
    """A sensor_msgs/JointState."""
    return {
        "header": header("", stamp),
        "name": names,
        "position": positions,
        "velocity": [],
        "effort": [],
    }
