"""Grasps of an object that a session may end with."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from chsel.belief import Gripper
from chsel.errors import ChselError, SettingError
from chsel.numerics.arrays import FloatArray, frozen, read_npz
from chsel.problem.poses import nearest_rigid
from chsel.problem.settings import CheckedSettings, at_most, positive


class Grasps(NamedTuple):
    """Grasps of the object, one of which is to be sure."""

    object_from_gripper: FloatArray  # (G, 4, 4)
    width: FloatArray  # (G,), between the fingers, metres
    gripper: Gripper
    sure: float  # chance that is wanted


@dataclass(frozen=True)
class GraspConfig(CheckedSettings):
    """Grasps that a session ends with."""

    path: str | None = None  # .npz: object_from_gripper (G, 4, 4), width (G,) or one, metres
    sure: Annotated[float, positive, at_most(1.0)] = 0.95  # chance that one of them works
    gripper: Gripper = field(default_factory=Gripper)

    def grasps(self) -> Grasps | None:
        """Return the grasps of the file. Raise SettingError for one that is not valid."""
        if self.path is None:
            return None
        try:
            file = read_npz(Path(self.path), error=SettingError)
            if file.keys() != {"object_from_gripper", "width"}:
                raise SettingError(f"its arrays are {', '.join(file) or 'none'}")
            poses = frozen("object_from_gripper", file["object_from_gripper"], shape=(None, 4, 4))
            poses = nearest_rigid("object_from_gripper", poses)
            width = frozen("width", np.broadcast_to(file["width"], len(poses)), shape=(None,))
            if len(poses) == 0 or not width.min() > 0.0:
                raise SettingError("it has no grasp, or a width that is not above 0")
        except (ChselError, ValueError) as error:
            accepted = "an .npz file with object_from_gripper (G, 4, 4) and width (G,), metres"
            text = f"grasp.path is {self.path} ({error}); accepted: {accepted}"
            raise SettingError(text) from None
        return Grasps(poses, width, gripper=self.gripper, sure=self.sure)
