"""All points known so far, for viewers, which show only the last message of each topic."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray

LEVELS = 4
_BLOCKS = 8  # that one level holds before they move to the next


class CumulativePoints:
    """Spreads points over levels: the newest at level 0, each further level 8 times as large.

    The levels together hold all points. A level is written anew when it changes, so that a point
    is written about 4 times at each level it passes, however long the session. Writing all points
    anew at every step would take quadratic space.
    """

    def __init__(self) -> None:
        self._levels: list[list[FloatArray]] = [[] for _ in range(LEVELS)]

    def add(self, points: FloatArray) -> dict[int, FloatArray]:
        """Take new points (N, 3); the levels that change, and all points (M, 3) of each."""
        changed: dict[int, FloatArray] = {}
        moving = [points]
        for level, blocks in enumerate(self._levels):
            if len(blocks) < _BLOCKS - 1 or level == LEVELS - 1:
                blocks.append(np.concatenate(moving))
                changed[level] = np.concatenate(blocks)
                break
            moving = [*blocks, *moving]
            blocks.clear()
            changed[level] = np.zeros((0, 3))
        return changed
