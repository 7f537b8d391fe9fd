"""Grasps of an object that a session may end with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from chsel.belief import Gripper
from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, frozen
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
        """The grasps of the file. Raises SettingError if it is not as it should be."""
        if self.path is None:
            return None
        try:
            with np.load(self.path) as file:
                poses, width = file["object_from_gripper"], file["width"]
            poses = nearest_rigid("grasp.path", frozen("object_from_gripper", poses, (None, 4, 4)))
            width = frozen("width", np.broadcast_to(width, len(poses)), (None,))
        except (OSError, ValueError, KeyError, TypeError) as error:
            accepted = "an .npz file with object_from_gripper (G, 4, 4) and width (G,), metres"
            why = getattr(error, "strerror", None) or error.args[0]
            text = f"grasp.path is {self.path} ({why}); accepted: {accepted}"
            raise SettingError(text) from None
        return Grasps(poses, width, self.gripper, self.sure)
