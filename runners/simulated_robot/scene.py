"""The robot cell in a physics engine: what its cameras see, and what touches."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose
from runners.simulated_robot.settings import RenderedCamera

AWAY = compose(np.eye(3), np.array([0.0, 0.0, -100.0]))
"""Where no camera sees the hand."""


class Scene(Protocol):
    """An object at its pose in the cabinet, and the hand, which goes wherever it is put."""

    def depth(
        self,
        camera: RenderedCamera,
        world_from_camera: FloatArray,
        *,
        world_from_wrist: FloatArray = AWAY,
    ) -> FloatArray:
        """Return depth (H, W) along z, metres, camera.far for nothing; without a wrist, no hand.

        Nothing nearer than camera.near is seen. Accurate to some micrometres.
        """

    def is_blocked(self, world_from_wrist: FloatArray) -> bool:
        """Return whether the hand's rigid parts touch anything, or are in it."""

    def close(self) -> None:
        """Release the engine."""
