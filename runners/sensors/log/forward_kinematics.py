"""The pose of a robot's link, by its URDF and the positions of its joints."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from runners.sensors.urdf import urdf_class


class Arm:
    """A chain of links from a base to the one that is followed."""

    def __init__(self, path: Path, root: str | None, *, link: str | None) -> None:
        """Read a URDF. root: the base, by default that of the file. Raise SettingError."""
        where = f"urdf {path}"
        reader = urdf_class(path, where)
        try:
            self._robot: Any = reader.load(str(path), build_scene_graph=True, load_meshes=False)
        except Exception as error:  # it raises whatever it stumbles over
            reason = " ".join(str(error).split())[:200]
            raise SettingError(f"{where} cannot be read ({reason}); accepted: a URDF") from None
        links = [one.name for one in self._robot.robot.links]
        self._root = root or str(self._robot.base_link)
        self._link = link or ""
        for name in (self._root, self._link):
            if name not in links:
                raise SettingError(f"{where} has no link {name}; it has {', '.join(links)}")

    def require(self, joints: Collection[str]) -> None:
        """Raise SettingError unless these are all that move the link."""
        actuated = set(self._robot.actuated_joint_names)
        unknown = sorted(set(joints) - actuated)
        if unknown:
            raise SettingError(
                f"joints {', '.join(unknown)} are not in the URDF; it has {', '.join(actuated)}"
            )
        moving = {joint.child: joint for joint in self._robot.robot.joints}
        name = self._link
        needed = set()
        while name in moving and name != self._root:
            joint = moving[name]
            if joint.name in actuated:
                needed.add(joint.name)
            name = joint.parent
        missing = sorted(needed - set(joints))
        if missing:
            raise SettingError(
                f"joints lack {', '.join(missing)}, which move {self._link}; accepted: all between "
                f"{self._root} and {self._link}"
            )

    def pose(self, positions: Mapping[str, float]) -> FloatArray:
        """Return root_from_link (4, 4) at positions of joints, radians or metres."""
        self._robot.update_cfg(dict(positions))
        return np.asarray(self._robot.get_transform(self._link, self._root), dtype=np.float64)
