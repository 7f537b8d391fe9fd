"""The registry of all sensors of robots' logs, by the settings of a rig."""

from __future__ import annotations

from chsel.errors import SettingError
from runners.sensors.clouds import Cloud
from runners.sensors.depth_camera import DepthCamera
from runners.sensors.forces import ForceSensor
from runners.sensors.hand import HAND, HandModel
from runners.sensors.pad import Pad
from runners.sensors.rig import Rig
from runners.sensors.sensor import Sensor
from runners.sensors.touch import TouchSensor


def sensors_of(rig: Rig, hand: HandModel | None) -> list[Sensor]:
    """Return the sensors of a rig in the order in which they are shown; hand: that of the rig.

    Raise SettingError for a rig without a sensor and a hand, and for a name that stands twice.
    """
    sensors: list[Sensor] = [
        *(DepthCamera(camera) for camera in rig.cameras),
        *(Pad(pad, rig.contact) for pad in rig.bubbles),
        *(TouchSensor(touch, rig.surface_resolution) for touch in rig.touches),
        *(Cloud(cloud, rig.surface_resolution) for cloud in rig.clouds),
        *(ForceSensor(force, rig.surface_resolution, hand=hand) for force in rig.forces),
    ]
    if not sensors and hand is None:
        raise SettingError(
            f"rig {rig.name} has no sensor; accepted: at least one, such as of cameras, or a hand"
        )
    names = [sensor.name for sensor in sensors] + ([HAND] if hand else [])
    if len(set(names)) < len(names):
        raise SettingError(
            f"sensors of rig {rig.name} are named {', '.join(names)}; accepted: each name once, "
            "where those of clouds and forces have the names of their topics"
        )
    return sensors
