"""Small logs as robots write them, with messages of all kinds that are read, and their sessions."""

import struct
from io import BytesIO
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from PIL import Image

from chsel.events import Logged, Probe
from chsel.problem.poses import compose
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.ros2_definitions import DEFINITIONS, full_definition
from runners.sessions.sensors import SensorsSettings, SensorsSource
from runners.simulated_robot.log_writer import camera_info, header, image, joint_state, transform

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND

Sent = tuple[str, str, Any, int]  # topic, type, message, log time


def read(path, rig, diameter=None):
    """The session of a log, its probes, and what was told."""
    session = SensorsSource(SensorsSettings(rig, str(path)), 0, diameter=diameter)
    events = list(session.probes())
    told = "\n".join(event.text for event in events if isinstance(event, Logged))
    return session, [event for event in events if isinstance(event, Probe)], told


def write_ros2(path, sent, *, chunk_size=2000, compression=CompressionType.ZSTD, finished=True):
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


def ros2_cloud(points, stamp, normals=None):
    """A sensor_msgs/PointCloud2 of one row of points (N, 3) and normals (N, 3), as float64."""
    names = ["x", "y", "z"]
    if normals is not None:
        names += ["normal_x", "normal_y", "normal_z"]
        points = np.concatenate([points, normals], axis=1)
    fields = [{"name": n, "offset": 8 * k, "datatype": 8, "count": 1} for k, n in enumerate(names)]
    return {
        "header": header("lidar", stamp),
        "height": 1,
        "width": len(points),
        "fields": fields,
        "point_step": 8 * len(names),
        "row_step": 8 * len(names) * len(points),
        "data": points.astype("<f8").tobytes(),
        "is_dense": True,
    }


def png(values):
    """A grey PNG, of 8 or 16 bits as the values (H, W) are."""
    file = BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


def depth(seed=0):
    """A depth image (3, 5), millimetres."""
    return np.random.default_rng(seed).integers(300, 900, (3, 5)).astype(np.uint16)


def xyz(*numbers):
    """A vector, or a quaternion."""
    return dict(zip("xyzw", numbers, strict=False))


def ros2_sent(count=4):
    """What a robot sends in a few seconds; log times are 1 ms after the stamps."""
    sent: list[Sent] = []
    for step in range(count):
        stamp = BEGIN + step * SECOND
        camera, base = {"header": header("camera", stamp)}, {"header": header("base", stamp)}
        above, moved = (compose(np.eye(3), np.array(p)) for p in ([0, 0, 1.0], [step, 0, 0.0]))
        info = camera_info(
            "camera", PinholeCamera(5, 3, fx=400.0, fy=410.0, cx=2.0, cy=1.0), stamp=stamp
        )
        packed = {**camera, "format": "png", "data": png(depth(step))}
        quantised = struct.pack("<iff", 1, 100.0, -20.0) + packed["data"]
        inverse = {**camera, "format": "32FC1; compressedDepth png", "data": quantised}
        pose = {"position": xyz(1.0, 2.0, 3.0), "orientation": xyz(0.0, 0.0, 0.5**0.5, 0.5**0.5)}
        wrench = {"force": xyz(1.0, 2.0, -3.0), "torque": xyz(0.25, 0.0, 0.5)}
        of_step: list[tuple[str, str, Any]] = [
            (
                "/tf_static",
                "TFMessage",
                {"transforms": [transform("base", "camera", parent_from_child=above, stamp=stamp)]},
            ),
            (
                "/tf",
                "TFMessage",
                {"transforms": [transform("world", "base", parent_from_child=moved, stamp=stamp)]},
            ),
            ("/depth", "Image", image("camera", depth(step), stamp=stamp)),
            ("/compressed", "CompressedImage", packed),
            ("/quantised", "CompressedImage", inverse),
            ("/info", "CameraInfo", info),
            ("/pose", "PoseStamped", {**base, "pose": pose}),
            ("/poses", "PoseArray", {**base, "poses": [pose, pose]}),
            ("/point", "PointStamped", {**base, "point": {"x": 1.0, "z": 2.0}}),
            ("/wrench", "WrenchStamped", {"header": header("hand", stamp), "wrench": wrench}),
            ("/joints", "JointState", joint_state(["elbow", "wrist"], [0.5, -0.25], stamp=stamp)),
            ("/cloud", "PointCloud2", ros2_cloud(np.arange(6.0).reshape(2, 3), stamp)),
            ("/probe", "String", {"data": f"begin {step}"}),
            ("/touch", "Bool", {"data": step % 2 == 0}),
            ("/count", "Int32", {"data": -step}),
        ]
        for topic, kind, message in of_step:
            (name,) = (name for name in DEFINITIONS if name.split("/")[1] == kind)
            sent.append((topic, name, message, stamp + 10**6))
    return sent
