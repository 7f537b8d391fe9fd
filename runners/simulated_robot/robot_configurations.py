"""The four cabinet configurations: how an object stands on the shelf, and where it is probed."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
import trimesh

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Workspace
from chsel.problem.poses import apply
from runners.sessions.configurations import Configuration
from runners.sessions.placement import laid_down

CABINET_WORKSPACE = Workspace((0.7, -0.2, 0.31), (1.1, 0.2, 0.6))
SHELF = 0.31  # m: height of its upper side
REST = (0.53, 0.0, 0.433)  # m: where the wrist is before a push, and what probes are relative to


@dataclass(frozen=True)
class CabinetConfiguration(Configuration):
    """How an object stands on the shelf, and the grid of its probes (methods, Sec. 10.1).

    position: of the centre of mass; its height is that at which the object stands. y, z: the
    wrist's offsets from its rest position in metres; all z for the first y, then for the next.
    """

    workspace: Workspace = CABINET_WORKSPACE


_ALL = (
    CabinetConfiguration(
        name="cabinet_drill",
        object="drill",
        position=(0.93, 0.0, SHELF),
        rotation=(0.0, 0.0, 0.0),
        y=(0.05, -0.08),
        z=(0.0, 0.05, 0.12),
    ),
    CabinetConfiguration(
        name="cabinet_drill_opposite",
        object="drill",
        position=(0.90, -0.015, SHELF),
        rotation=(0.0, 0.0, pi + 0.8),
        y=(0.07, -0.11),
        z=(-0.03, 0.05, 0.13),
    ),
    CabinetConfiguration(
        name="cabinet_mustard",
        object="mustard",
        position=(0.93, 0.01, SHELF),
        rotation=(0.0, 0.0, 0.0),
        y=(0.0, 0.05),
        z=(-0.02, 0.04, 0.13),
    ),
    CabinetConfiguration(
        name="cabinet_mustard_sideways",
        object="mustard",
        position=(0.93, 0.06, SHELF),
        rotation=(0.0, 0.0, pi / 2.0),
        y=(0.05, 0.12),
        z=(-0.02, 0.04, 0.13),
    ),
)

CABINET_CONFIGURATIONS = {configuration.name: configuration for configuration in _ALL}


def find_cabinet_configuration(name: str) -> CabinetConfiguration:
    """The configuration called `name`; SessionError if there is none, naming all."""
    if name not in CABINET_CONFIGURATIONS:
        raise SessionError(
            f"configuration {name!r} does not exist; accepted: {', '.join(CABINET_CONFIGURATIONS)}"
        )
    return CABINET_CONFIGURATIONS[name]


def stood_on_shelf(mesh: trimesh.Trimesh, configuration: CabinetConfiguration) -> FloatArray:
    """The pose world_from_object (4, 4) in which a mesh in metres stands in the cabinet.

    Raises SessionError if it reaches out of the workspace.
    """
    world_from_object = laid_down(mesh, configuration)
    world_from_object[2, 3] += SHELF
    placed = apply(world_from_object, np.asarray(mesh.vertices))
    box, slack = configuration.workspace, 1e-6
    if (placed.min(axis=0) < np.array(box.lower) - slack).any() or (
        placed.max(axis=0) > np.array(box.upper) + slack
    ).any():
        size = " x ".join(f"{side:.3g}" for side in np.ptp(placed, axis=0))
        room = " x ".join(f"{side:.3g}" for side in np.subtract(box.upper, box.lower))
        raise SessionError(
            f"the object takes {size} m where {configuration.name} puts it, more than the cabinet "
            f"has; accepted: an object of real size (object.scale=1) that fits in {room} m"
        )
    return world_from_object
