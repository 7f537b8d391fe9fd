"""What a message of a log holds, whatever its encoding and schema were."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.sensing.depth_camera import PinholeCamera


class UnusableMessage(ChselError):
    """A message is malformed, or of a kind that is not read; it is skipped and counted."""


@dataclass(frozen=True, eq=False)
class ImageMessage:
    """A depth or deformation image as it was sent.

    frame: of the camera's optical centre: x right, y down, z forward. values (H, W): uint16 (units
    are for the reader to know, usually millimetres) or float32 (usually metres).
    """

    frame: str
    values: np.ndarray


@dataclass(frozen=True)
class CameraInfoMessage:
    """Intrinsics of a camera.

    distorted: whether lens distortion was left in its images as they were taken.
    """

    camera: PinholeCamera  # of its images as they were taken: K
    distorted: bool = False
    rectified: PinholeCamera | None = None  # of rectified images: P


@dataclass(frozen=True, eq=False)
class TransformMessage:
    """Pose (4, 4) of a child frame in its parent's; static ones hold for all times.

    child: "" of a message of a pose alone, such as geometry_msgs/PoseStamped.
    """

    parent: str
    child: str
    parent_from_child: FloatArray
    static: bool = False


@dataclass(frozen=True, eq=False)
class CloudMessage:
    """Points (N, 3) in a frame, metres; those without a measurement are not finite."""

    frame: str
    points: FloatArray


@dataclass(frozen=True, eq=False)
class WrenchMessage:
    """A force and a torque in a frame and about its origin."""

    frame: str
    force: FloatArray  # (3,), newtons
    torque: FloatArray  # (3,), newton metres


Joints = dict[str, float]
"""Positions of joints by name, radians or metres; those that are not measured are not finite."""

Content = (
    ImageMessage
    | CameraInfoMessage
    | TransformMessage
    | CloudMessage
    | WrenchMessage
    | Joints
    | str  # of a marker: "begin 3" or "end", a number, "true" or "false"
)
Decoded = tuple[int | None, Content | UnusableMessage]
"""The sender's time, nanoseconds, where there is one, and one content of a message."""

Decode = Callable[[bytes], Iterator[Decoded]]
"""From the bytes of a message to its contents."""


@dataclass(frozen=True, eq=False)
class Received:
    """One message. stamp: nanoseconds, by the sender's clock; None where it gave none.

    log_time: nanoseconds, by the clock of whoever wrote the log. One message of transforms gives
    one Received for each.
    """

    topic: str
    log_time: int
    stamp: int | None
    content: Content
