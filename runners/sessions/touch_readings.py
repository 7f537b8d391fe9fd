"""The contact readings of a hand in a physics engine, and the touch that follows from them."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sessions.gripper import Touch
from runners.sessions.mesh_surface import MeshSurface

HAND_MASS = 0.9  # kg
TIME_STEP = 1.0 / 240.0  # s: of an engine
MINI_STEP = 21  # steps of an engine
FORCE_STEP = 5  # of a mini-step: when the force is read
READINGS = 50  # how many readings of contact are looked back upon
ENOUGH_READINGS = 2


class Reading(NamedTuple):
    """The contact between hand and object after a step of an engine, where it presses hardest."""

    contact: FloatArray
    """Point (3,) on the object, world."""

    normal: FloatArray
    """Normal (3,) across what touches, from the object to the hand."""

    force: float
    """Sum of all normal forces on the hand, newtons."""


class TouchReadings:
    """The latest readings, and where the touch that they belong to began."""

    def __init__(self) -> None:
        self._readings: deque[Reading | None] = deque(maxlen=READINGS)
        self._began: Reading | None = None
        self._normal = np.zeros(3)  # of the object's face where the touch began
        self._force = 0.0

    def clear(self) -> None:
        """Forget all readings, as the hand is put elsewhere."""
        self._readings.clear()
        self._began = None

    def add(self, step: int, reading: Reading | None, *, surface: MeshSurface) -> None:
        """Add the reading after a step (its index in the mini-step); None without contact."""
        if step == 0:
            self._force = 0.0
        if reading is not None and not any(self._readings):
            self._began = reading
            # The engine's is the hand's where that meets an edge, or across both edges.
            self._normal = surface.facing_normal(reading.contact, reading.normal)
        self._readings.append(reading)
        if step == FORCE_STEP and reading is not None:
            self._force = reading.force

    def touch(self, position: FloatArray) -> Touch:
        """Return the measurements at the end of a mini-step, with the hand at position (3,)."""
        touching = sum(reading is not None for reading in self._readings)
        if self._began is None or touching < ENOUGH_READINGS:
            return Touch(position, self._force)
        # As the hand presses on, the engine's contact wanders over the faces that touch by some
        # millimetres; where the touch began is known best.
        return Touch(position, self._force, contact=self._began.contact, normal=self._normal)
