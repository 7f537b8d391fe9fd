"""Every sensor of a rig is in the registry, follows the protocol, and accounts for its points."""

from dataclasses import fields, is_dataclass, replace
from typing import get_args, get_type_hints

import numpy as np
import pytest

from chsel.errors import SettingError
from runners.sensors.hand import HandModel
from runners.sensors.log import messages
from runners.sensors.registry import sensors_of
from runners.sensors.rig import (
    CloudRig,
    ColumnRig,
    ExtraContacts,
    ForceRig,
    Rig,
    TouchRig,
    TrajectoryRig,
)
from runners.sensors.sensor import Sensor
from tests.runners.sensors.small_logs import read
from tests.runners.sensors.sphere_log import CENTRE, LIDAR, RADIUS, RIG, SphereLog

CLOUDS = (CloudRig("/lidar", "surface"), CloudRig("/skin", "contacts"))
TOUCH = TouchRig("finger", "/height", 0.0003)
EVERY = replace(RIG, clouds=CLOUDS, forces=(ForceRig("/wrench"),), touches=(TOUCH,))
HAND = HandModel(RIG.hand)


def test_the_registry_has_all_sensors_that_a_rig_can_name():
    hints = get_type_hints(Rig)
    listed = {
        field.name: get_args(hints[field.name])[0]
        for field in fields(Rig)
        if get_args(hints[field.name])[1:] == (Ellipsis,)
    }
    assert listed.pop("trajectories") is TrajectoryRig  # poses, which give no points
    assert listed.pop("columns") is ColumnRig  # topics
    assert all(is_dataclass(kind) for kind in listed.values())
    assert all(len(getattr(EVERY, name)) > 0 for name in listed)
    named = sum(len(getattr(EVERY, name)) for name in listed)
    assert len(sensors_of(EVERY, HAND)) == named


@pytest.mark.parametrize("sensor", sensors_of(EVERY, HAND), ids=lambda sensor: sensor.name)
def test_a_sensor_follows_the_protocol(sensor):
    members = {name for name in dir(Sensor) if not name.startswith("_")}
    assert members == {"name", "topics", "frame", "prepare", "take", "finish", "remark"}
    assert members <= {name for name in members if hasattr(sensor, name)}
    assert sensor.topics[0].content.noun
    kinds = {name for name in vars(messages) if name.endswith("Message")}
    for topic in sensor.topics:
        assert topic.content.__name__ in kinds
        assert topic.name.startswith("/")
        assert topic.use


def test_all_known_points_are_counted_by_the_sensors_that_gave_them(tmp_path):
    ways = np.random.default_rng(3).normal(size=(200, 3)) * [1.0, 1.0, 0.2]
    on_sphere = CENTRE + RADIUS * ways / np.sqrt((ways**2).sum(axis=1, keepdims=True))
    log = SphereLog(cloud=tuple(map(tuple, (on_sphere - LIDAR).tolist())))
    path = log.write(tmp_path / "log.mcap")
    extra = ExtraContacts(1, ((0.9, 0.0, 0.49), (0.9, 0.04, 0.45)))
    annotations = replace(RIG.annotations, contacts=(extra,))
    session, probes, _ = read(path, replace(RIG, clouds=CLOUDS, annotations=annotations))
    added = {0: 0, 1: 2}
    for probe in probes:
        counts = session.report.by_probe[probe.step]
        assert list(counts) == ["camera", "pad", "/lidar", "/skin", "hand"]
        surface = counts["/lidar"].contacts
        touched = counts["pad"].contacts + counts["/skin"].contacts + added[probe.step]
        assert len(probe.contacts) == touched
        assert len(probe.new_points.known) == touched + surface
        # In this order: the pad's, those annotated, those of the skin, then the surface.
        at = counts["pad"].contacts
        np.testing.assert_array_equal(
            probe.new_points.known[at : at + added[probe.step]],
            np.reshape(extra.points, (-1, 3))[: added[probe.step]],
        )
    assert session.report.by_probe[0]["pad"].contacts == 50
    assert session.report.by_probe[0]["/skin"].contacts > 50


@pytest.mark.parametrize(
    "changes",
    [
        {"cameras": (RIG.cameras[0], RIG.cameras[0])},
        {"bubbles": (replace(RIG.bubbles[0], name="camera"),)},
        {"cameras": (replace(RIG.cameras[0], name="hand"),)},
        {"clouds": (CLOUDS[0], replace(CLOUDS[1], topic="/lidar"))},
    ],
)
def test_a_name_that_stands_twice_is_refused(changes):
    with pytest.raises(SettingError, match=r"sensors of rig sphere are named .*each name once"):
        sensors_of(replace(RIG, **changes), HAND)
