"""The 17 configurations: how an object lies before the gripper, and where it is probed."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from chsel.errors import SessionError
from chsel.problem.points import Workspace

Triple = tuple[float, float, float]

WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.3, 0.625))
HAMMER_WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.5, 0.4))

# Angle in radians about z that turns the longer side of a mesh's footprint along an axis.
MESH_YAW = {"drill": -0.58, "mustard": -0.59, "cracker_box": 0.17, "spam_can": 0.90}


@dataclass(frozen=True)
class Configuration:
    """Where an object is let go, and the grid of its probes.

    object: whose configuration it is. position: of the centre of mass, metres, in the world.
    rotation: roll, pitch, yaw in radians about the world's axes x, y, z, in this order. y, z: the
    gripper's positions in metres; all z for the first y, then for the next. workspace: the box in
    which the object is sought.
    """

    name: str
    object: str
    position: Triple
    rotation: Triple
    y: tuple[float, ...]
    z: tuple[float, ...]
    workspace: Workspace = WORKSPACE

    @property
    def grid(self) -> list[tuple[float, float]]:
        """The probes (y, z) in their order."""
        return [(y, z) for y in self.y for z in self.z]


_DRILL_Y = (0.0, 0.2, 0.3, -0.2, -0.3)

_ALL = (
    Configuration(
        name="drill",
        object="drill",
        position=(0.27, 0.0, 0.2),
        rotation=(0.0, 0.0, 0.0),
        y=_DRILL_Y,
        z=(0.05, 0.15, 0.25, 0.325, 0.4, 0.5),
    ),
    Configuration(
        name="drill_opposite",
        object="drill",
        position=(0.33, 0.0, 0.2),
        rotation=(0.0, 0.0, pi),
        y=_DRILL_Y,
        z=(0.05, 0.15, 0.25, 0.4, 0.51),
    ),
    Configuration(
        name="drill_slanted",
        object="drill",
        position=(0.35, 0.1, 0.2),
        rotation=(0.0, 0.0, 2.0 * pi / 3.0),
        y=_DRILL_Y,
        z=(0.05, 0.15, 0.25, 0.4, 0.51),
    ),
    Configuration(
        name="drill_fallen",
        object="drill",
        position=(0.25, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 0.2),
        y=_DRILL_Y,
        z=(0.05, 0.18, 0.25, 0.4),
    ),
    Configuration(
        name="mustard",
        object="mustard",
        position=(0.25, 0.0, 0.2),
        rotation=(0.0, 0.0, 0.0),
        y=(0.0, 0.18, 0.24, -0.25),
        z=(0.05, 0.2, 0.35, 0.52),
    ),
    Configuration(
        name="mustard_sideways",
        object="mustard",
        position=(0.25, 0.03, 0.2),
        rotation=(0.0, 0.0, pi / 2.0),
        y=(0.0, 0.2, -0.2),
        z=(0.05, 0.2, 0.35, 0.52),
    ),
    Configuration(
        name="mustard_fallen",
        object="mustard",
        position=(0.25, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 0.2),
        y=(0.0, 0.3, -0.15, -0.36),
        z=(0.05, 0.2, 0.35),
    ),
    Configuration(
        name="mustard_fallen_sideways",
        object="mustard",
        position=(0.25, 0.0, 0.2),
        rotation=(pi / 2.0, pi / 2.0, 0.4),
        y=(0.0, 0.2, 0.35, -0.2, -0.35),
        z=(0.05, 0.12, 0.2),
    ),
    Configuration(
        name="hammer",
        object="hammer",
        position=(0.25, 0.1, 0.2),
        rotation=(0.0, 0.0, 0.0),
        y=(0.0, -0.2, 0.2, 0.4),
        z=(0.05, 0.15, 0.25, 0.4),
        workspace=HAMMER_WORKSPACE,
    ),
    Configuration(
        name="hammer_straight",
        object="hammer",
        position=(0.52, 0.0, 0.3),
        rotation=(pi / 2.0, 1.2, 0.0),
        y=(0.0, 0.15, -0.15),
        z=(0.05, 0.1, 0.2, 0.4),
    ),
    Configuration(
        name="hammer_fallen",
        object="hammer",
        position=(0.3, 0.05, 0.3),
        rotation=(-0.3, 0.4, 0.4),
        y=(0.0, 0.15, 0.4, -0.15),
        z=(0.05, 0.15, 0.25),
        workspace=HAMMER_WORKSPACE,
    ),
    Configuration(
        name="box",
        object="cracker_box",
        position=(0.25, 0.0, 0.2),
        rotation=(0.0, 0.0, pi / 2.0),
        y=(0.0, 0.18, -0.2),
        z=(0.05, 0.15, 0.25, 0.37),
    ),
    Configuration(
        name="box_fallen",
        object="cracker_box",
        position=(0.25, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 0.2),
        y=(0.0, 0.15, 0.25, -0.1),
        z=(0.05, 0.15, 0.3),
    ),
    Configuration(
        name="can",
        object="spam_can",
        position=(0.25, 0.0, 0.2),
        rotation=(0.0, 0.0, 0.0),
        y=(0.0, 0.2, -0.15),
        z=(0.05, 0.12, 0.2, 0.3),
    ),
    Configuration(
        name="can_fallen",
        object="spam_can",
        position=(0.25, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 0.2),
        y=(0.0, 0.15, 0.25, -0.1),
        z=(0.05, 0.12, 0.2),
    ),
    Configuration(
        name="clamp",
        object="clamp",
        position=(0.3, 0.0, 0.2),
        rotation=(0.0, 0.0, pi),
        y=(0.0, 0.18, -0.2),
        z=(0.05, 0.08, 0.15, 0.25),
    ),
    Configuration(
        name="clamp_sideways",
        object="clamp",
        position=(0.32, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 2.0),
        y=(0.0, 0.22, -0.23),
        z=(0.05, 0.18, 0.26, 0.32),
    ),
)

CONFIGURATIONS = {configuration.name: configuration for configuration in _ALL}


def find_configuration(name: str, object_name: str | None = None) -> Configuration:
    """The configuration called `name`; with `object_name`, it must be one of that object's.

    An object that has no configurations of its own takes any. Raises SessionError for an unknown
    name and for a configuration of another object, naming those that would be accepted.
    """
    if name not in CONFIGURATIONS:
        fitting = fitting_configurations(object_name) or list(CONFIGURATIONS)
        raise SessionError(f"configuration {name!r} does not exist; accepted: {', '.join(fitting)}")
    configuration = CONFIGURATIONS[name]
    fitting = fitting_configurations(object_name)
    if fitting and name not in fitting:
        raise SessionError(
            f"configuration {name} is one of object {configuration.object}; accepted for object "
            f"{object_name}: {', '.join(fitting)}"
        )
    return configuration


def fitting_configurations(object_name: str | None) -> list[str]:
    """Names of the configurations of an object; none for an object without any."""
    return [name for name, entry in CONFIGURATIONS.items() if entry.object == object_name]
