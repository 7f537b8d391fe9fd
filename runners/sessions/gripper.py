"""The gripper's control in simulated sources, and the protocol of their engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose
from chsel.problem.streams import Purpose, StreamKey
from runners.sessions.probing_settings import ProbingSettings

MINI_STEPS = 15  # of a control step
X_REST = -0.05  # m: where the gripper moves sideways, before the object
START = (X_REST, 0.0, 0.2)  # m: where it is before the first probe
GAIN = 30.0  # command per metre of error
TOLERANCE = 3e-4  # m: what counts as arrived
MOST_STEPS = 60  # control steps after which a move that something blocks is given up
NOISE_ROWS = 5000  # of the table that all methods share
_BACK = 0.05  # m: by which a start is moved back while the object is there
_FARTHEST_BACK = 40  # times


@dataclass(frozen=True, eq=False)
class Touch:
    """Measurements of a gripper at the end of a mini-step."""

    position: FloatArray
    """Position (3,) of the hand, world."""

    force: float = 0.0
    """Force on the object, newtons."""

    contact: FloatArray | None = None
    """Point (3,) on the object's surface, world; None without contact."""

    normal: FloatArray | None = None
    """Normal (3,) out of the object's face at the contact; on an edge, of one of its faces."""


class Engine(Protocol):
    """A world with an object that resists every push, and a gripper that starts at START."""

    world_from_object: FloatArray
    """Pose (4, 4) of the mesh."""

    def move(self, world_from_object: FloatArray) -> None:
        """Put the object at a pose (4, 4); the hand should be away from it."""

    def advance(self, target: FloatArray) -> Touch:
        """Move the hand towards target (3,), a mini-step away, as far as it goes."""

    def place(self, pose: FloatArray) -> bool:
        """Put the hand at a pose (4, 4); False, and not to be used, if the object is there."""

    def close(self) -> None:
        """End the world. Ending twice is ending once."""


class SimulatedGripper:
    """The hand's control: proportional, noisy, in control steps of MINI_STEPS mini-steps."""

    path: list[FloatArray]
    """Positions (3,) since `forget`, at the ends of mini-steps."""

    ends: list[FloatArray]
    """Positions (3,) since `forget`, at the ends of control steps."""

    contacts: list[FloatArray]
    """Points (3,) on the object since `forget`."""

    normals: list[FloatArray]
    """Outward normals (3,) of the object at the contacts."""

    def __init__(self, engine: Engine, settings: ProbingSettings, *, seed: int) -> None:
        self._engine = engine
        self._settings = settings
        stream = StreamKey(seed, 0).stream(Purpose.CONTROL_NOISE)
        self._noise = settings.noise * stream.standard_normal((NOISE_ROWS, 3))
        self._steps = 0
        self._position = np.array(START)
        self.path = [self._position]
        self.forget()

    def forget(self) -> None:
        """Forget the positions and contacts so far, but for the last position."""
        self.path = self.path[-1:]
        self.ends = self.path[-1:]
        self.contacts = []
        self.normals = []

    def move_to(self, y: float, z: float) -> None:
        """Go sideways to y and z, metres."""
        self._go(np.array([0.0, y, z]), np.array([0.0, 1.0, 1.0]))

    def push(self) -> None:
        """Go forward until something resists, or for so many control steps."""
        for _ in range(self._settings.push_steps):
            if self._control_step(np.array([1.0, 0.0, 0.0])) > self._settings.stop_force:
                return

    def withdraw(self) -> None:
        """Go back before the object."""
        self._go(np.array([X_REST, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))

    def probe_along(self, pose: FloatArray, length: float) -> None:
        """Start at a pose (4, 4), go along its z axis until something resists, and return.

        length: of the way if nothing does, metres. If the object is at the start, the hand comes
        from behind it and goes so much farther.
        Raise SessionError if there is no place behind the start, either.
        """
        direction = pose[:3, 2]
        start, left = self._clear_start(pose, length)
        self._position, self.path = start, [start]
        self.forget()
        while left > TOLERANCE:
            part = min(left, self._settings.step_length)
            command = part / self._settings.step_length * direction
            if self._control_step(command) > self._settings.stop_force:
                break
            left -= part
        self._go(start, np.ones(3), straight=True)

    def _go(self, target: FloatArray, axes: FloatArray, *, straight: bool = False) -> None:
        """Go to a target (3,) along some axes (3,), 0 or 1 each, or straight."""
        for _ in range(MOST_STEPS):
            error = (target - self._position) * axes
            if np.sqrt(error @ error) < TOLERANCE:
                return
            command = GAIN * error
            length = float(np.sqrt(command @ command)) if straight else 1.0
            self._control_step(command / max(1.0, length))

    def _clear_start(self, pose: FloatArray, length: float) -> tuple[FloatArray, float]:
        """Put the hand at a pose (4, 4), or behind it; where that is (3,), and the way from it."""
        for times in range(_FARTHEST_BACK):
            back = times * _BACK
            start = pose[:3, 3] - back * pose[:3, 2]
            if self._engine.place(compose(pose[:3, :3], start)):
                return start, length + back
        raise SessionError(
            f"the object is at the start of a probe, {pose[:3, 3].tolist()}, and behind it for "
            f"{_FARTHEST_BACK * _BACK:g} m; accepted: starts beside the object"
        )

    def _control_step(self, command: FloatArray) -> float:
        """Follow a command (3,) within [-1, 1]; the median force over mini-steps, newtons."""
        noisy = np.clip(command + self._noise[self._steps % NOISE_ROWS], -1.0, 1.0)
        self._steps += 1
        start = self._position
        displacement = self._settings.step_length * noisy
        forces = []
        for mini_step in range(MINI_STEPS):
            fraction = (mini_step + 1) / MINI_STEPS
            touch = self._engine.advance(start + fraction * displacement)
            self.path.append(touch.position)
            forces.append(touch.force)
        self._position = touch.position
        self.ends.append(touch.position)
        if touch.contact is not None and touch.normal is not None:
            self.contacts.append(touch.contact)
            self.normals.append(touch.normal)
        return float(np.median(forces))
