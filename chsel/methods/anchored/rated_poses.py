"""Poses and their energies, chosen and ordered together."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import Poses


class RatedPoses(NamedTuple):
    """Poses with their energies."""

    poses: Poses
    energies: FloatArray  # (B,), metres

    @classmethod
    def joined(cls, *parts: RatedPoses) -> RatedPoses:
        """Those of all parts, in their order."""
        energies = np.concatenate([part.energies for part in parts])
        return cls(Poses.joined([part.poses for part in parts]), energies)

    def chosen(self, which: Any) -> RatedPoses:
        """Some of them: a slice, flags (B,) or indices."""
        return RatedPoses(self.poses[which], self.energies[which])

    def ordered(self) -> RatedPoses:
        """The lowest first."""
        return self.chosen(np.argsort(self.energies, kind="stable"))
