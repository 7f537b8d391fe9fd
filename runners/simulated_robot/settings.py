"""Settings of the simulated robot: its sensors, and how often and how far it pushes."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, tan
from typing import Annotated

from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive
from chsel.sensing.depth_camera import PinholeCamera
from runners.sessions.faults import number_between
from runners.sessions.physics_engine import ENGINES
from runners.simulated_robot.cabinet import CAP, CAP_BASE

VIEW = 80.0  # degrees: of the outer camera, horizontal

Width = Annotated[int, number_between(16, 4096, unit=" pixels")]
Rate = Annotated[float, positive, at_most(50.0)]  # Hz: of the simulated clock at most
Duration = Annotated[float, not_negative, at_most(60.0)]


@dataclass(frozen=True)
class RenderedCamera(PinholeCamera):
    """A camera that the physics engine renders."""

    near: float  # metres, between which something can be seen
    far: float


@dataclass(frozen=True)
class CameraSettings(CheckedSettings):
    """The depth camera outside. Its image is three quarters as high as wide."""

    width: Width = 640  # pixels
    rate: Rate = 2.0  # images a second

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / tan(VIEW * pi / 360.0)
        return _centred(self.width, self.width * 3 // 4, focal=focal, near=0.05, far=6.0)


@dataclass(frozen=True)
class BubbleSettings(CheckedSettings):
    """The depth cameras in the two pads, which just see all of their membranes."""

    width: Width = 224  # pixels, along the longer side
    rate: Rate = 10.0  # images a second

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / (CAP[0] / CAP_BASE)
        return _centred(self.width, self.width * 171 // 224, focal=focal, near=0.02, far=0.5)


def _centred(width: int, height: int, *, focal: float, near: float, far: float) -> RenderedCamera:
    """Return a camera that looks through the middle of its image."""
    cx, cy = (width - 1) / 2.0, (height - 1) / 2.0
    return RenderedCamera(width, height, fx=focal, fy=focal, cx=cx, cy=cy, near=near, far=far)


@dataclass(frozen=True)
class RobotSettings(CheckedSettings):
    """Settings of the robot's probes and sensors."""

    probes: Annotated[int | None, positive] = None  # of the configuration's grid; null: all
    camera: CameraSettings = field(default_factory=CameraSettings)
    bubbles: BubbleSettings = field(default_factory=BubbleSettings)
    push_steps: Annotated[int, number_between(1, 5)] = 5  # of 5 cm, of a push at most
    standing: Duration = 1.5  # seconds before the first probe
    dwell: Duration = 0.6  # seconds at the end of a push
    drop: Annotated[float, number_between(0, 0.9)] = 0.02  # part of the images that are lost
    engine: Annotated[str, one_of(*ENGINES)] | None = None  # null: PyBullet if there, else MuJoCo
