"""Small logs as robots write them, with one message or more of all kinds that are read."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from PIL import Image

from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.ros2_definitions import full_definition
from runners.simulated_robot.log_writer import camera_info, header, image, joint_state

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
QUARTER_TURN = (0.0, 0.0, 0.5**0.5, 0.5**0.5)  # about z

Sent = tuple[str, str, Any, int]  # topic, type, message, log time


def write_ros2(
    path: Path,
    sent: Sequence[Sent],
    *,
    chunk_size: int = 2000,
    compression: CompressionType = CompressionType.ZSTD,
    finished: bool = True,
) -> bytes:
    """A ROS 2 log; its bytes."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=compression)
        schemas: dict[str, Any] = {}
        for topic, kind, message, log_time in sent:
            if kind not in schemas:
                name = kind.replace("/", "/msg/")
                schemas[kind] = writer.register_msgdef(name, full_definition(kind))
            writer.write_message(topic, schemas[kind], message, log_time)
        if finished:
            writer.finish()
    return path.read_bytes()


def ros2_image(values: np.ndarray, stamp: int, **changes: Any) -> dict[str, Any]:
    """A sensor_msgs/Image, its rows with four bytes of padding."""
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    rows = np.pad(rows, ((0, 0), (0, 4)))
    return (
        image("camera", values, stamp) | {"step": rows.shape[1], "data": rows.tobytes()} | changes
    )


def ros2_transform(
    parent: str,
    child: str,
    position: Sequence[float],
    stamp: int,
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> dict[str, Any]:
    """A geometry_msgs/TransformStamped."""
    transform = {
        "translation": dict(zip("xyz", position, strict=True)),
        "rotation": dict(zip("xyzw", quaternion, strict=True)),
    }
    return {"header": header(parent, stamp), "child_frame_id": child, "transform": transform}


def ros2_cloud(points: np.ndarray, stamp: int) -> dict[str, Any]:
    """A sensor_msgs/PointCloud2 of one row: z first, y as float64, then four bytes of nothing."""
    kind = np.dtype({"names": list("zxy"), "formats": [">f4", ">f4", ">f8"], "itemsize": 20})
    packed = np.zeros(len(points), kind)
    for axis, name in enumerate("xyz"):
        packed[name] = points[:, axis]
    fields = [
        {"name": name, "offset": kind.fields[name][1], "datatype": 8 if name == "y" else 7}
        for name in "zxy"
    ]
    return {
        "header": header("lidar", stamp),
        "height": 1,
        "width": len(points),
        "fields": [{**field, "count": 1} for field in fields],
        "is_bigendian": True,
        "point_step": 20,
        "row_step": 20 * len(points),
        "data": packed.tobytes(),
        "is_dense": True,
    }


def png(values: np.ndarray) -> bytes:
    """A grey PNG, of 8 or 16 bits as the values (H, W) are."""
    file = BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


def depth(seed: int = 0) -> np.ndarray:
    """A depth image (3, 5), millimetres."""
    return np.random.default_rng(seed).integers(300, 900, (3, 5)).astype(np.uint16)


def ros2_sent(count: int = 4) -> list[Sent]:
    """What a robot sends in a few seconds; log times are 1 ms after the stamps."""
    sent: list[Sent] = []
    for step in range(count):
        stamp = BEGIN + step * SECOND
        camera, base = {"header": header("camera", stamp)}, {"header": header("base", stamp)}
        fixed = ros2_transform("base", "camera", (0.0, 0.0, 1.0), stamp)
        moved = ros2_transform("world", "base", (step, 0.0, 0.0), stamp)
        info = camera_info("camera", PinholeCamera(5, 3, 400.0, 410.0, 2.0, 1.0), stamp)
        packed = {**camera, "format": "png", "data": png(depth(step))}
        quantised = struct.pack("<iff", 1, 100.0, -20.0) + packed["data"]
        inverse = {**camera, "format": "32FC1; compressedDepth png", "data": quantised}
        pose = {
            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
            "orientation": dict(zip("xyzw", QUARTER_TURN, strict=True)),
        }
        wrench = {
            "force": {"x": 1.0, "y": 2.0, "z": -3.0},
            "torque": {"x": 0.25, "y": 0.0, "z": 0.5},
        }
        joints = joint_state(["elbow", "wrist"], [0.5, -0.25], stamp)
        cloud = ros2_cloud(np.arange(6.0).reshape(2, 3), stamp)
        of_step: list[tuple[str, str, Any]] = [
            ("/tf_static", "tf2_msgs/TFMessage", {"transforms": [fixed]}),
            ("/tf", "tf2_msgs/TFMessage", {"transforms": [moved]}),
            ("/depth", "sensor_msgs/Image", ros2_image(depth(step), stamp)),
            ("/compressed", "sensor_msgs/CompressedImage", packed),
            ("/quantised", "sensor_msgs/CompressedImage", inverse),
            ("/info", "sensor_msgs/CameraInfo", info),
            ("/pose", "geometry_msgs/PoseStamped", {**base, "pose": pose}),
            ("/poses", "geometry_msgs/PoseArray", {**base, "poses": [pose, pose]}),
            ("/point", "geometry_msgs/PointStamped", {**base, "point": {"x": 1.0, "z": 2.0}}),
            (
                "/wrench",
                "geometry_msgs/WrenchStamped",
                {"header": header("hand", stamp), "wrench": wrench},
            ),
            ("/joints", "sensor_msgs/JointState", joints),
            ("/cloud", "sensor_msgs/PointCloud2", cloud),
            ("/probe", "std_msgs/String", {"data": f"begin {step}"}),
            ("/touch", "std_msgs/Bool", {"data": step % 2 == 0}),
            ("/count", "std_msgs/Int32", {"data": -step}),
        ]
        sent += [(*one, stamp + 10**6) for one in of_step]
    return sent
