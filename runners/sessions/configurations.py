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
    """Where an object is let go, and the grid of its probes."""

    name: str
    object: str  # whose configuration it is
    y: tuple[
        float, ...
    ]  # the gripper's positions, metres: all z for the first y, then for the next
    z: tuple[float, ...]
    position: Triple = (0.25, 0.0, 0.2)  # of the centre of mass in the world, metres
    rotation: Triple = (0.0, 0.0, 0.0)  # radians about the world's axes x, y, z, in this order
    workspace: Workspace = WORKSPACE  # in which the object is sought

    @property
    def grid(self) -> list[tuple[float, float]]:
        """The probes (y, z) in their order."""
        return [(y, z) for y in self.y for z in self.z]


_DRILL_Y = (0.0, 0.2, 0.3, -0.2, -0.3)
_DRILL_Z = (0.05, 0.15, 0.25, 0.4, 0.51)
_FALLEN = (pi / 2.0, 0.0, 0.2)

_ALL = (
    Configuration(
        "drill",
        "drill",
        _DRILL_Y,
        (0.05, 0.15, 0.25, 0.325, 0.4, 0.5),
        position=(0.27, 0.0, 0.2),
    ),
    Configuration("drill_opposite", "drill", _DRILL_Y, _DRILL_Z, (0.33, 0.0, 0.2), (0.0, 0.0, pi)),
    Configuration(
        "drill_slanted", "drill", _DRILL_Y, _DRILL_Z, (0.35, 0.1, 0.2), (0.0, 0.0, 2.0 * pi / 3.0)
    ),
    Configuration("drill_fallen", "drill", _DRILL_Y, (0.05, 0.18, 0.25, 0.4), rotation=_FALLEN),
    Configuration("mustard", "mustard", (0.0, 0.18, 0.24, -0.25), (0.05, 0.2, 0.35, 0.52)),
    Configuration(
        "mustard_sideways",
        "mustard",
        (0.0, 0.2, -0.2),
        (0.05, 0.2, 0.35, 0.52),
        position=(0.25, 0.03, 0.2),
        rotation=(0.0, 0.0, pi / 2.0),
    ),
    Configuration(
        "mustard_fallen", "mustard", (0.0, 0.3, -0.15, -0.36), (0.05, 0.2, 0.35), rotation=_FALLEN
    ),
    Configuration(
        "mustard_fallen_sideways",
        "mustard",
        (0.0, 0.2, 0.35, -0.2, -0.35),
        (0.05, 0.12, 0.2),
        rotation=(pi / 2.0, pi / 2.0, 0.4),
    ),
    Configuration(
        "hammer",
        "hammer",
        (0.0, -0.2, 0.2, 0.4),
        (0.05, 0.15, 0.25, 0.4),
        position=(0.25, 0.1, 0.2),
        workspace=HAMMER_WORKSPACE,
    ),
    Configuration(
        "hammer_straight",
        "hammer",
        (0.0, 0.15, -0.15),
        (0.05, 0.1, 0.2, 0.4),
        position=(0.52, 0.0, 0.3),
        rotation=(pi / 2.0, 1.2, 0.0),
    ),
    Configuration(
        "hammer_fallen",
        "hammer",
        (0.0, 0.15, 0.4, -0.15),
        (0.05, 0.15, 0.25),
        position=(0.3, 0.05, 0.3),
        rotation=(-0.3, 0.4, 0.4),
        workspace=HAMMER_WORKSPACE,
    ),
    Configuration(
        "box",
        "cracker_box",
        (0.0, 0.18, -0.2),
        (0.05, 0.15, 0.25, 0.37),
        rotation=(0.0, 0.0, pi / 2.0),
    ),
    Configuration(
        "box_fallen", "cracker_box", (0.0, 0.15, 0.25, -0.1), (0.05, 0.15, 0.3), rotation=_FALLEN
    ),
    Configuration("can", "spam_can", (0.0, 0.2, -0.15), (0.05, 0.12, 0.2, 0.3)),
    Configuration(
        "can_fallen", "spam_can", (0.0, 0.15, 0.25, -0.1), (0.05, 0.12, 0.2), rotation=_FALLEN
    ),
    Configuration(
        "clamp",
        "clamp",
        (0.0, 0.18, -0.2),
        (0.05, 0.08, 0.15, 0.25),
        position=(0.3, 0.0, 0.2),
        rotation=(0.0, 0.0, pi),
    ),
    Configuration(
        "clamp_sideways",
        "clamp",
        (0.0, 0.22, -0.23),
        (0.05, 0.18, 0.26, 0.32),
        position=(0.32, 0.0, 0.2),
        rotation=(pi / 2.0, 0.0, 2.0),
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
