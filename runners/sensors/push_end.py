"""The moment of a probe at which the hand is furthest along its own z axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sensors.cell import Cell
from runners.sensors.depth_source import View
from runners.sensors.pad import Pad


@dataclass(frozen=True, eq=False)
class PushEnd:
    """Points (N, 3) of all membranes in the world then, N > 0, and world_from_hand (4, 4)."""

    membranes: FloatArray
    world_from_hand: FloatArray

    def foremost_mean(self, count: int) -> FloatArray:
        """The mean (1, 3) of the `count` points that lie furthest along the hand's z axis."""
        ahead = self.membranes @ self.world_from_hand[:3, 2]
        foremost = np.argsort(-ahead, kind="stable")[:count]
        return self.membranes[foremost].mean(axis=0, keepdims=True)


class PushWatch:
    """Keeps of every pad the image in which the hand was furthest."""

    def __init__(self, frame: str, cell: Cell) -> None:
        """frame: of the hand, z pointing forward."""
        self._frame, self._cell = frame, cell
        self._furthest: dict[str, tuple[float, FloatArray, Pad, View]] = {}

    def take(self, time: int, name: str, pad: Pad, view: View) -> None:
        """An image of the pad called `name`, between the probe's begin and end."""
        pose = self._cell.world_from(self._frame, time, "hand")
        if pose is None:
            return
        advance = float(pose[:3, 2] @ pose[:3, 3])
        if name not in self._furthest or advance > self._furthest[name][0]:
            self._furthest[name] = (advance, pose, pad, view)

    def next(self) -> PushEnd | None:
        """The end of the push, None if no membrane was seen; then the next probe begins."""
        furthest, self._furthest = list(self._furthest.values()), {}
        if not furthest:
            return None
        membranes = np.concatenate([pad.membrane(view) for _, _, pad, view in furthest])
        return PushEnd(membranes, max(furthest, key=lambda entry: entry[0])[1])
