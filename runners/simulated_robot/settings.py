"""How the simulated robot records: its sensors, its motion, and what goes wrong in its log."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, tan
from typing import Annotated, Self

from chsel.errors import SettingError
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.sensing.depth_camera import PinholeCamera
from runners.sessions.faults import number_between
from runners.simulated_robot.wrist import CAP, CAP_BASE

_DEPTH = 0.25  # m: that a push may go

Width = Annotated[int, number_between(16, 4096, " pixels")]
Rate = Annotated[float, positive, at_most(50.0)]  # Hz: of the simulated clock at most
Length = Annotated[float, not_negative]
Speed = Annotated[float, positive]
Duration = Annotated[float, not_negative, at_most(60.0)]


@dataclass(frozen=True)
class RenderedCamera(PinholeCamera):
    """A camera that the physics engine renders."""

    near: float  # metres, between which something can be seen
    far: float

    @classmethod
    def centred(cls, size: tuple[int, int], focal: float, near: float, far: float) -> Self:
        """A camera of width and height in pixels that looks through the middle of its image."""
        width, height = size
        centre = (width - 1) / 2.0, (height - 1) / 2.0
        return cls(width, height, focal, focal, *centre, near, far)


@dataclass(frozen=True)
class CameraSettings(CheckedSettings):
    """The depth camera outside. Its image is three quarters as high as wide."""

    width: Width = 640  # pixels
    view: Annotated[float, number_between(1, 150, " degrees")] = 80.0  # horizontal, degrees
    rate: Rate = 2.0  # images a second
    noise: Length = 0.0025  # standard deviation at 1 m, metres; it grows with the depth squared
    baseline: Length = 0.05
    """Metres between its two eyes, of which one sees past edges what the other does not."""

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / tan(self.view * pi / 360.0)
        size = (self.width, max(self.width * 3 // 4, 1))
        return RenderedCamera.centred(size, focal, near=0.05, far=6.0)


@dataclass(frozen=True)
class BubbleSettings(CheckedSettings):
    """The depth cameras in the two pads, which just see all of their membranes."""

    width: Width = 224  # pixels, along the longer side
    rate: Rate = 10.0  # images a second
    noise: Length = 0.0003  # standard deviation, metres

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / (CAP[0] / CAP_BASE)
        size = (self.width, max(self.width * 171 // 224, 1))
        return RenderedCamera.centred(size, focal, near=0.02, far=0.5)


@dataclass(frozen=True)
class RobotSettings(CheckedSettings):
    """How the robot probes and records."""

    probes: Annotated[int | None, positive] = None  # of the configuration's grid; null: all
    camera: CameraSettings = field(default_factory=CameraSettings)
    bubbles: BubbleSettings = field(default_factory=BubbleSettings)
    push_step: Annotated[float, positive] = 0.05  # metres
    push_steps: Annotated[int, positive] = 5  # of a push at most
    push_speed: Speed = 0.05  # metres a second
    move_speed: Speed = 0.15
    standing: Duration = 1.5  # seconds before the first probe
    dwell: Duration = 0.6  # seconds at the end of a push
    spread: Annotated[float, number_between(0, 0.01, " m")] = 0.003
    """Standard deviation of the wrist's place in a probe."""

    compressed: bool = False  # the outer camera's images as PNG
    drop: Annotated[float, number_between(0, 0.9)] = 0.02  # part of the images that are lost
    clock_offset: Annotated[float, number_between(-1e6, 1e6, " s")] = 0.0
    """Seconds by which the outer camera's clock is ahead."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.push_step * self.push_steps > _DEPTH + 1e-9:
            raise SettingError(
                f"push_step {self.push_step} m times push_steps {self.push_steps} is beyond the "
                f"cabinet's depth; accepted: {_DEPTH} m at most"
            )
