"""Whether an object is as large as the real one that sensors have met."""

from __future__ import annotations

import numpy as np

from chsel.errors import MeshWarning
from chsel.problem.points import Workspace
from runners.objects.loader import ObjectModel


def check_size(model: ObjectModel, workspace: Workspace) -> list[MeshWarning]:
    """A warning for an object that is enlarged, or longer than the workspace.

    The objects of simulated sessions are enlarged by default; points of one's own are of real ones.
    """
    longest = float(model.mesh.extents.max())
    side = float(np.ptp(workspace.bounds, axis=0).max())
    if model.scale <= 1.0 and longest <= side:
        return []
    text = (
        f"the object is {longest:.3g} m long at scale {model.scale:g}, the workspace "
        f"{side:.3g} m; objects of real size have object.scale=1"
    )
    return [MeshWarning("object_size", text)]
