"""The solid parts of the hand: boxes of the rig, and the links of a URDF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.problem.poses import compose, roll_pitch_yaw
from runners.sensors.rig import BoxRig, HandRig
from runners.sensors.urdf import Linkage

if TYPE_CHECKING:
    import trimesh


class HandModel:
    """The solids of a hand, read once, placed as often as joints move.

    joint_names: joints whose values move any of them. warnings: what a user should know of how
    they were read. Raises SettingError for a URDF that cannot be used.
    """

    def __init__(self, rig: HandRig) -> None:
        self._boxes = [_solid(box) for box in rig.boxes]
        self._linkage = None if rig.urdf is None else Linkage(Path(rig.urdf), rig.root)
        self.joint_names = () if self._linkage is None else self._linkage.joint_names
        self.warnings = () if self._linkage is None else self._linkage.warnings

    def parts(self, joints: Mapping[str, float] | None = None) -> list[trimesh.Trimesh]:
        """Closed solids in the hand's frame, metres; they may overlap.

        joints: values by name, radians or metres. Those of other joints do not matter, missing
        ones are 0.
        """
        links = [] if self._linkage is None else self._linkage.solids(joints or {})
        return self._boxes + links

    def solids(self, joints: Mapping[str, float] | None = None) -> trimesh.Trimesh | None:
        """All parts as one mesh of several closed bodies; None if the rig describes none."""
        import trimesh

        parts = self.parts(joints)
        joined: Any = trimesh.util.concatenate(parts) if parts else None
        return joined


def _solid(box: BoxRig) -> trimesh.Trimesh:
    import trimesh

    hand_from_box = compose(roll_pitch_yaw(np.array(box.rotation)), np.array(box.position))
    return trimesh.creation.box(box.size, hand_from_box)
