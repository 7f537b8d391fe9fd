"""The content of messages of a log, whatever their encoding and schema were."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.sensing.depth_camera import PinholeCamera


class UnusableMessage(ChselError):
    """A message is malformed, or of a kind that is not read; it is skipped and counted."""


@dataclass(frozen=True, eq=False)
class ImageMessage:
    """A depth or deformation image as it was sent."""

    noun: ClassVar[str] = "depth images"

    frame: str
    """Frame of the camera's optical centre: x right, y down, z forward."""

    values: np.ndarray
    """(H, W): uint16 (units are for the reader to know, usually mm) or float32 (usually m)."""


@dataclass(frozen=True)
class CameraInfoMessage:
    """Intrinsics of a camera."""

    noun: ClassVar[str] = "camera infos"

    camera: PinholeCamera
    """Intrinsics K, of its images as they were taken."""

    distortion: tuple[float, ...] = ()
    """Coefficients of the lens, of its images as they were taken; none where all are 0."""

    distortion_model: str = ""
    """What they mean, see `chsel.sensing.lens.LensDistortion`."""

    rectified: PinholeCamera | None = None
    """Intrinsics P, of rectified images."""


@dataclass(frozen=True, eq=False)
class TransformMessage:
    """A pose of a child frame in its parent's."""

    parent: str
    """Name of the parent frame."""

    child: str
    """Name of the child frame; "" of a pose alone, such as geometry_msgs/PoseStamped."""

    parent_from_child: FloatArray
    """Pose (4, 4), metres."""

    static: bool = False
    """Whether it holds for all times."""


@dataclass(frozen=True, eq=False)
class CloudMessage:
    """Points in a frame."""

    noun: ClassVar[str] = "points"

    frame: str
    """Name of the frame."""

    points: FloatArray
    """(N, 3), metres; those without a measurement are not finite."""

    normals: FloatArray | None = None
    """(N, 3), as they were sent, of any length; None if they were not."""


@dataclass(frozen=True, eq=False)
class WrenchMessage:
    """A force and a torque in a frame and about its origin."""

    noun: ClassVar[str] = "forces"

    frame: str  # name of the frame
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
    """One message, or one of the transforms of a message."""

    topic: str
    """Name of its topic."""

    log_time: int
    """Nanoseconds, by the clock of the program that wrote the log."""

    stamp: int | None
    """Nanoseconds, by the sender's clock; None where it gave none."""

    content: Content
    """Decoded content."""
