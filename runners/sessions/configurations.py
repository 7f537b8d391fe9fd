"""The paper's 17 configurations: the pose of an object before the gripper, and its probes."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from chsel.errors import require_choice
from chsel.problem.points import Workspace
from runners.objects.loader import FITTED

Triple = tuple[float, float, float]

WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.3, 0.625))
HAMMER_WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.5, 0.4))

# Angle in radians about z that turns the longer side of a mesh's footprint along an axis.
MESH_YAW = {"drill": -0.58, "mustard": -0.59, "cracker_box": 0.17, "spam_can": 0.90}


@dataclass(frozen=True)
class Configuration:
    """The place at which an object is let go, and the grid of its probes."""

    name: str
    object: str  # whose configuration it is
    # The gripper's positions, metres: all z for the first y, then for the next.
    y: tuple[float, ...]
    z: tuple[float, ...]
    position: Triple = (0.25, 0.0, 0.2)  # of the centre of mass in the world, metres
    rotation: Triple = (0.0, 0.0, 0.0)  # radians about the world's axes x, y, z, in this order
    workspace: Workspace = WORKSPACE  # in which the object is sought
    stand: float = 0.0  # height of what the object lies on, metres above the floor
    free_resolution: float = 0.025  # side of a free voxel where settings name none, metres

    @property
    def grid(self) -> list[tuple[float, float]]:
        """The probes (y, z) in their order."""
        return [(y, z) for y in self.y for z in self.z]


_DRILL_Y = (0.0, 0.2, 0.3, -0.2, -0.3)
_DRILL_Z = (0.05, 0.15, 0.25, 0.4, 0.51)
_AS_MODELLED = (0.0, 0.0, 0.0)
_TURNED = (0.0, 0.0, pi / 2.0)
_FALLEN = (pi / 2.0, 0.0, 0.2)

_GRIDS = {
    "drill": (_DRILL_Y, (0.05, 0.15, 0.25, 0.325, 0.4, 0.5)),
    "drill_opposite": (_DRILL_Y, _DRILL_Z),
    "drill_slanted": (_DRILL_Y, _DRILL_Z),
    "drill_fallen": (_DRILL_Y, (0.05, 0.18, 0.25, 0.4)),
    "mustard": ((0.0, 0.18, 0.24, -0.25), (0.05, 0.2, 0.35, 0.52)),
    "mustard_sideways": ((0.0, 0.2, -0.2), (0.05, 0.2, 0.35, 0.52)),
    "mustard_fallen": ((0.0, 0.3, -0.15, -0.36), (0.05, 0.2, 0.35)),
    "mustard_fallen_sideways": ((0.0, 0.2, 0.35, -0.2, -0.35), (0.05, 0.12, 0.2)),
    "hammer": ((0.0, -0.2, 0.2, 0.4), (0.05, 0.15, 0.25, 0.4)),
    "hammer_straight": ((0.0, 0.15, -0.15), (0.05, 0.1, 0.2, 0.4)),
    "hammer_fallen": ((0.0, 0.15, 0.4, -0.15), (0.05, 0.15, 0.25)),
    "box": ((0.0, 0.18, -0.2), (0.05, 0.15, 0.25, 0.37)),
    "box_fallen": ((0.0, 0.15, 0.25, -0.1), (0.05, 0.15, 0.3)),
    "can": ((0.0, 0.2, -0.15), (0.05, 0.12, 0.2, 0.3)),
    "can_fallen": ((0.0, 0.15, 0.25, -0.1), (0.05, 0.12, 0.2)),
    "clamp": ((0.0, 0.18, -0.2), (0.05, 0.08, 0.15, 0.25)),
    "clamp_sideways": ((0.0, 0.22, -0.23), (0.05, 0.18, 0.26, 0.32)),
}
"""y and z of the gripper, metres."""
_PLACES: dict[str, tuple[str, Triple, Triple]] = {
    "drill": ("drill", (0.27, 0.0, 0.2), _AS_MODELLED),
    "drill_opposite": ("drill", (0.33, 0.0, 0.2), (0.0, 0.0, pi)),
    "drill_slanted": ("drill", (0.35, 0.1, 0.2), (0.0, 0.0, 2.0 * pi / 3.0)),
    "drill_fallen": ("drill", (0.25, 0.0, 0.2), _FALLEN),
    "mustard": ("mustard", (0.25, 0.0, 0.2), _AS_MODELLED),
    "mustard_sideways": ("mustard", (0.25, 0.03, 0.2), _TURNED),
    "mustard_fallen": ("mustard", (0.25, 0.0, 0.2), _FALLEN),
    "mustard_fallen_sideways": ("mustard", (0.25, 0.0, 0.2), (pi / 2.0, pi / 2.0, 0.4)),
    "hammer": ("hammer", (0.25, 0.1, 0.2), _AS_MODELLED),
    "hammer_straight": ("hammer", (0.52, 0.0, 0.3), (pi / 2.0, 1.2, 0.0)),
    "hammer_fallen": ("hammer", (0.3, 0.05, 0.3), (-0.3, 0.4, 0.4)),
    "box": ("cracker_box", (0.25, 0.0, 0.2), _TURNED),
    "box_fallen": ("cracker_box", (0.25, 0.0, 0.2), _FALLEN),
    "can": ("spam_can", (0.25, 0.0, 0.2), _AS_MODELLED),
    "can_fallen": ("spam_can", (0.25, 0.0, 0.2), _FALLEN),
    "clamp": ("clamp", (0.3, 0.0, 0.2), (0.0, 0.0, pi)),
    "clamp_sideways": ("clamp", (0.32, 0.0, 0.2), (pi / 2.0, 0.0, 2.0)),
}
"""Object, position and rotation."""
_WORKSPACES = {"hammer": HAMMER_WORKSPACE, "hammer_fallen": HAMMER_WORKSPACE}

CONFIGURATIONS = {
    name: Configuration(
        name,
        object_name,
        y=_GRIDS[name][0],
        z=_GRIDS[name][1],
        position=position,
        rotation=rotation,
        workspace=_WORKSPACES.get(name, WORKSPACE),
    )
    for name, (object_name, position, rotation) in _PLACES.items()
}


def find_configuration(name: str, object_name: str | None = None) -> Configuration:
    """Return the configuration `name` of the 17; with `object_name`, one of that object's.

    An object without configurations takes any. Raise SettingError for a name that
    is not accepted.
    """
    fitting = [key for key, one in CONFIGURATIONS.items() if one.object == object_name]
    require_choice("configuration", name, accepted=[*(fitting or CONFIGURATIONS), FITTED])
    return CONFIGURATIONS[name]
