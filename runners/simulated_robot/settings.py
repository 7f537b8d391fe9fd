"""How the twin records: its sensors, its motion, and what goes wrong in its log."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, tan
from typing import Self

from chsel.errors import SettingError, require_at_most, require_positive
from chsel.sensing.depth_camera import PinholeCamera
from runners.simulated_robot.wrist import CAP, CAP_BASE

_LARGEST = 4096  # pixels
_FASTEST = 50.0  # Hz: of the simulated clock


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
class CameraSettings:
    """The depth camera outside. Its image is three quarters as high as wide.

    width: pixels. view: horizontal, degrees. rate: images a second. noise: standard deviation of
    a depth of 1 m, metres; it grows with the depth squared. baseline: metres, between the two eyes
    of a stereo camera, of which one sees past edges what the other does not.
    """

    width: int = 640
    view: float = 80.0
    rate: float = 2.0
    noise: float = 0.0025
    baseline: float = 0.05

    def __post_init__(self) -> None:
        _check_sensor(self.width, self.rate, self.noise)
        require_positive("baseline", self.baseline, zero=True)
        if not 1.0 <= self.view <= 150.0:
            raise SettingError(f"view is {self.view}; accepted: 1 to 150 degrees")

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / tan(self.view * pi / 360.0)
        size = (self.width, max(self.width * 3 // 4, 1))
        return RenderedCamera.centred(size, focal, near=0.05, far=6.0)


@dataclass(frozen=True)
class BubbleSettings:
    """The depth cameras in the two pads, which just see all of their membranes.

    width: pixels, along the longer side. rate: images a second. noise: standard deviation, metres.
    """

    width: int = 224
    rate: float = 10.0
    noise: float = 0.0003

    def __post_init__(self) -> None:
        _check_sensor(self.width, self.rate, self.noise)

    @property
    def pinhole(self) -> RenderedCamera:
        focal = self.width / 2.0 / (CAP[0] / CAP_BASE)
        size = (self.width, max(self.width * 171 // 224, 1))
        return RenderedCamera.centred(size, focal, near=0.02, far=0.5)


@dataclass(frozen=True)
class RobotSettings:
    """How the twin records.

    probes: how many of the configuration's grid; null: all. push_step, push_steps: metres, and how
    many of them a push has at most. push_speed, move_speed: metres a second. standing: seconds
    before the first probe. dwell: seconds at the end of a push. spread: standard deviation of the
    wrist's place in a probe, metres. compressed: PNG messages of the outer camera's images.
    Faults: drop, part of the images that are lost; clock_offset, seconds by which the outer
    camera's clock is ahead.
    """

    probes: int | None = None
    camera: CameraSettings = field(default_factory=CameraSettings)
    bubbles: BubbleSettings = field(default_factory=BubbleSettings)
    push_step: float = 0.05
    push_steps: int = 5
    push_speed: float = 0.05
    move_speed: float = 0.15
    standing: float = 1.5
    dwell: float = 0.6
    spread: float = 0.003
    compressed: bool = False
    drop: float = 0.02
    clock_offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("push_step", "push_steps", "push_speed", "move_speed"):
            require_positive(name, getattr(self, name))
        for name in ("standing", "dwell", "spread", "drop"):
            require_positive(name, getattr(self, name), zero=True)
        if self.probes is not None:
            require_positive("probes", self.probes)
        if self.push_step * self.push_steps > 0.25 + 1e-9:
            raise SettingError(
                f"push_step {self.push_step} m times push_steps {self.push_steps} is beyond the "
                "cabinet's depth; accepted: 0.25 m at most"
            )
        if self.drop > 0.9:
            raise SettingError(f"drop is {self.drop}; accepted: 0 to 0.9")
        if self.spread > 0.01:
            raise SettingError(f"spread is {self.spread}; accepted: 0 to 0.01 m")
        for name in ("standing", "dwell"):
            require_at_most(name, getattr(self, name), 60.0)
        if not -1e6 <= self.clock_offset <= 1e6:
            raise SettingError(f"clock_offset is {self.clock_offset}; accepted: -1e6 to 1e6 s")


def _check_sensor(width: int, rate: float, noise: float) -> None:
    if not 16 <= width <= _LARGEST:
        raise SettingError(f"width is {width}; accepted: 16 to {_LARGEST} pixels")
    require_positive("rate", rate)
    require_at_most("rate", rate, _FASTEST)
    require_positive("noise", noise, zero=True)
