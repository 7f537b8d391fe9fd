"""A log of a made-up robot that presses a bubble pad onto a sphere while a camera looks on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, inverse
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.rig import BoxRig, BubbleRig, CameraRig, ContactRig, HandRig, Rig
from runners.simulated_robot.log_writer import (
    LogWriter,
    camera_info,
    image,
    joint_state,
    transform,
)

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
LATENCY = 4_000_000  # ns from a stamp to its log time

CENTRE, RADIUS = np.array([0.9, 0.0, 0.45]), 0.04
WALL = 1.08  # m: x of a wall behind the sphere
MEMBRANE = 0.06  # m: from the pad's camera to its untouched membrane, a plane
PRESSED = 0.012  # m: how far the membrane's plane reaches into the sphere at the end of a push
ASIDE = 0.12  # m: by which the second probe passes the sphere

OUTER = PinholeCamera(96, 72, 90.0, 90.0, 47.5, 35.5)
INNER = PinholeCamera(48, 36, 50.0, 50.0, 23.5, 17.5)

# The hand's z axis, and so that of the pad's camera, is the world's x axis.
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
HAND_FROM_PAD = compose(np.eye(3), np.array([0.0, 0.0, 0.1]))
WORLD_FROM_CAMERA = compose(
    np.array([[0.6, 0.0, 0.8], [-0.8, 0.0, 0.6], [0.0, -1.0, 0.0]]), np.array([0.54, -0.27, 0.45])
)

RIG = Rig(
    name="sphere",
    world="world",
    workspace=((0.7, 1.1), (-0.2, 0.2), (0.3, 0.6)),
    cameras=(
        CameraRig(
            "camera", "/camera/depth", "/camera/info", range=(0.1, 2.0), rate=None, edge_reach=1
        ),
    ),
    bubbles=(BubbleRig("pad", "/pad/depth", "/pad/info", range=(0.01, 0.1)),),
    contact=ContactRig(filter=3, points=50),
    hand=HandRig("hand", boxes=(BoxRig((0.04, 0.06, 0.08), (0.0, 0.0, 0.04)),)),
    markers="/probe",
)


class Writer(Protocol):
    """Takes the messages: a LogWriter, or whoever wants to see them."""

    def add(
        self, topic: str, kind: str, message: dict[str, Any], stamp: int, log_time: int
    ) -> None:
        """One message; times in nanoseconds."""


@dataclass(frozen=True)
class SphereLog:
    """How the log is written. marks: times in seconds and texts of the markers.

    unit: metres of a unit of the camera's images. camera_clock: seconds by which it is ahead.
    lost_transforms: seconds between which the hand sends none. left_out: topics without messages.
    finger: metres at which a joint of this name stands; None: no joint is told of.
    """

    marks: tuple[tuple[float, str], ...] = (
        (0.95, "begin 0"),
        (2.95, "end 0"),
        (3.05, "begin 1"),
        (4.95, "end 1"),
    )
    unit: float = 0.001
    camera_clock: float = 0.0
    lost_transforms: tuple[float, float] = (0.0, 0.0)
    left_out: tuple[str, ...] = ()
    finger: float | None = None

    def write(self, path: Path) -> Path:
        """The log as a file."""
        with LogWriter(path) as writer:
            self.send(writer)
        return path

    def send(self, writer: Writer) -> None:
        """Five seconds: standing, a push onto the sphere, and one that passes it."""
        for tick in range(101):
            seconds = tick * 0.05
            stamp = BEGIN + round(seconds * SECOND)
            self._send(writer, tick, seconds, stamp)
        for seconds, text in self.marks:
            time = BEGIN + round(seconds * SECOND) + LATENCY
            self._add(writer, "/probe", "std_msgs/String", {"data": text}, time, time)

    def _send(self, writer: Writer, tick: int, seconds: float, stamp: int) -> None:
        hand = hand_pose(seconds)
        log = stamp + LATENCY
        lost, found = self.lost_transforms
        if not lost <= seconds < found:
            moving = {"transforms": [transform("world", "hand", hand, stamp)]}
            self._add(writer, "/tf", "tf2_msgs/TFMessage", moving, stamp, log)
        if self.finger is not None:
            joints = joint_state(["elbow", "finger"], [seconds, self.finger], stamp)
            self._add(writer, "/joint_states", "sensor_msgs/JointState", joints, stamp, log)
        if tick == 0:
            fixed = [
                transform("hand", "pad_frame", HAND_FROM_PAD, stamp),
                transform("world", "camera_frame", WORLD_FROM_CAMERA, stamp),
            ]
            self._add(writer, "/tf_static", "tf2_msgs/TFMessage", {"transforms": fixed}, stamp, log)
        if tick % 2 == 0:
            depth = membrane(hand).astype(np.float32)
            self._image(writer, "pad", INNER, depth, stamp, log)
        if tick % 10 == 0:
            ahead = stamp + round(self.camera_clock * SECOND)
            numbers = np.rint(seen() / self.unit).astype(np.uint16)
            self._image(writer, "camera", OUTER, numbers, ahead, log)

    def _image(
        self,
        writer: Writer,
        name: str,
        camera: PinholeCamera,
        values: np.ndarray,
        stamp: int,
        log: int,
    ) -> None:
        frame = f"{name}_frame"
        info = camera_info(frame, camera, stamp)
        self._add(writer, f"/{name}/info", "sensor_msgs/CameraInfo", info, stamp, log)
        sent = image(frame, values, stamp)
        self._add(writer, f"/{name}/depth", "sensor_msgs/Image", sent, stamp, log)

    def _add(
        self, writer: Writer, topic: str, kind: str, message: dict, stamp: int, log: int
    ) -> None:
        if topic not in self.left_out:
            writer.add(topic, kind, message, stamp, log)


def hand_pose(seconds: float) -> FloatArray:
    """Pose (4, 4) of the hand in the world: two pushes of two seconds, the second one aside."""
    push, within = divmod(seconds - 1.0, 2.0)
    travel = 1.0 - abs(within - 1.0) if push >= 0 else 0.0
    furthest = CENTRE[0] - RADIUS + PRESSED - MEMBRANE - HAND_FROM_PAD[2, 3]
    x = furthest - 0.1 * (1.0 - travel)
    return compose(FORWARD, np.array([x, ASIDE * (push >= 1), CENTRE[2]]))


def membrane(hand: FloatArray) -> FloatArray:
    """Depth (H, W) in the pad: the untouched plane, or the sphere where it is nearer."""
    return np.minimum(MEMBRANE, to_sphere(INNER, hand @ HAND_FROM_PAD))


def seen() -> FloatArray:
    """Depth (H, W) in the camera: the sphere, or the wall behind it."""
    return np.minimum(to_wall(OUTER, WORLD_FROM_CAMERA), to_sphere(OUTER, WORLD_FROM_CAMERA))


def to_sphere(camera: PinholeCamera, world_from_camera: FloatArray) -> FloatArray:
    """Depth (H, W) at which rays meet the sphere, infinite if they do not."""
    ways = camera.directions()
    centre = inverse(world_from_camera)[:3] @ [*CENTRE, 1.0]
    a, b = (ways**2).sum(axis=-1), ways @ centre
    root = b**2 - a * (centre @ centre - RADIUS**2)
    return np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)


def to_wall(camera: PinholeCamera, world_from_camera: FloatArray) -> FloatArray:
    """Depth (H, W) at which rays meet the wall."""
    ways = camera.directions() @ world_from_camera[:3, :3].T
    return (WALL - world_from_camera[0, 3]) / ways[..., 0]


def changed(rig: Rig = RIG, **changes: object) -> Rig:
    """The rig with other values."""
    return replace(rig, **changes)
