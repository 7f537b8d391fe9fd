"""Rigs with a hand alone, and contacts that a force sensor in the wrist feels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, compose, inverse, roll_pitch_yaw
from chsel.problem.settings import build_settings
from replay.events import Logged, Probe
from runners.command.choices import CONF
from runners.sensors.rig import Annotations, BoxRig, ForceRig, HandRig, Rig
from runners.sessions.sensors import SensorsSession, SensorsSettings
from runners.simulated_robot.log_writer import header, transform
from tests.runners.sensors.small_logs import BEGIN, SECOND, write_ros2

HAND = HandRig("hand", boxes=(BoxRig((0.04, 0.06, 0.1), (0.0, 0.0, 0.05)),))
FORCES = ForceRig("/wrench")
RIG = Rig(
    "pusher",
    "world",
    ((0.2, 0.8), (-0.3, 0.3), (-0.1, 0.4)),
    boundary="none",
    hand=HAND,
    forces=(FORCES,),
    markers="/probe",
)
HAND_FROM_SENSOR = compose(roll_pitch_yaw(np.array([0.3, -0.2, 0.9])), np.array([0.0, 0.01, -0.06]))
WEIGHT = np.array([1.0, -2.0, 4.0, 0.3, 0.1, -0.2])  # of the hand, N and Nm, in the sensor's frame
TIP = np.array([0.012, -0.017, 0.1])  # m: where the hand is touched, in its frame
FORCE = np.array([1.0, -0.5, -6.0])  # N on the hand, with friction, in its frame


def hand_pose(seconds: float) -> FloatArray:
    """The hand goes along the world's x axis, which is its z axis, for a second, and back."""
    travel = max(0.0, 1.0 - abs(seconds - 2.0))
    forward = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    return compose(forward, np.array([0.3 + 0.1 * travel, 0.0, 0.1]))


def wrench(seconds: float, *, torque: bool = True, settled: float = 0.0) -> dict[str, Any]:
    """A geometry_msgs/WrenchStamped; the hand is in contact for 0.1 s.

    settled: seconds before which the sensor measures twice the hand's weight.
    """
    force, moment = np.zeros(3), np.zeros(3)
    if abs(seconds - 2.0) < 0.055 or abs(seconds - 1.5) < 1e-6:  # and a spike
        sensor_from_hand = inverse(HAND_FROM_SENSOR)
        force = sensor_from_hand[:3, :3] @ FORCE
        moment = np.cross(apply(sensor_from_hand, TIP[None])[0], force)
    numbers = np.concatenate([force, moment]) + WEIGHT * (2.0 if seconds < settled else 1.0)
    numbers = numbers if torque else np.concatenate([numbers[:3], np.zeros(3)])
    parts = [dict(zip("xyz", part, strict=True)) for part in (numbers[:3], numbers[3:])]
    return {
        "header": header("ft", BEGIN + round(seconds * SECOND)),
        "wrench": dict(zip(("force", "torque"), parts, strict=True)),
    }


def write_log(
    path: Path,
    *,
    torque: bool = True,
    settled: float = 0.0,
    forces: bool = True,
    marks: bool = True,
) -> Path:
    """Four seconds at 100 Hz."""
    fixed = {"transforms": [transform("hand", "ft", HAND_FROM_SENSOR, BEGIN)]}
    sent = [("/tf_static", "tf2_msgs/TFMessage", fixed, BEGIN)]
    for tick in range(401):
        seconds = tick * 0.01
        stamp = BEGIN + round(seconds * SECOND)
        moving = {"transforms": [transform("world", "hand", hand_pose(seconds), stamp)]}
        sent.append(("/tf", "tf2_msgs/TFMessage", moving, stamp))
        if forces:
            felt = wrench(seconds, torque=torque, settled=settled)
            sent.append(("/wrench", "geometry_msgs/WrenchStamped", felt, stamp))
    for seconds, text in ((1.0, "begin 0"), (3.0, "end 0")) if marks else ():
        stamp = BEGIN + round(seconds * SECOND)
        sent.append(("/probe", "std_msgs/String", {"data": text}, stamp))
    write_ros2(path, sorted(sent, key=lambda one: one[3]))
    return path


def read(path: Path, rig: Rig = RIG) -> tuple[SensorsSession, Probe, str]:
    session = SensorsSession(SensorsSettings(rig, str(path)), 0)
    events = list(session.probes())
    told = "\n".join(event.text for event in events if isinstance(event, Logged))
    (probe,) = (event for event in events if isinstance(event, Probe))
    return session, probe, told


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "log.mcap")


def test_a_contact_is_where_the_line_of_force_enters_the_hand(log: Path) -> None:
    session, probe, told = read(log)
    counts = session.report.total()["/wrench"]
    assert len(probe.contacts) == counts.contacts == 2  # 10 mm of way are two voxels of 5 mm
    in_hand = apply(inverse(hand_pose(2.0)), probe.contacts)
    np.testing.assert_allclose(in_hand[:, :2], np.tile(TIP[:2], (2, 1)), atol=1e-5)
    assert ((in_hand[:, 2] > TIP[2] - 0.0055) & (in_hand[:, 2] < TIP[2] + 1e-6)).all()
    np.testing.assert_allclose(probe.contact_normals, [[-1.0, 0.0, 0.0]] * 2, atol=1e-6)
    assert probe.outcome == "contact"
    assert (counts.images, counts.used, counts.spikes) == (401, 201, 1)  # the spike
    assert "/wrench: left out of 401 messages: 1 of forces that do not last" in told


def test_free_space_is_what_the_hand_swept_and_none_behind_the_contact(log: Path) -> None:
    probe = read(log)[1]
    free = probe.new_points.free
    assert len(free) > 300
    foremost = hand_pose(2.0)[0, 3] + 0.1
    assert free[:, 0].max() > foremost - 0.01
    near = np.sqrt(((free[:, None] - probe.contacts) ** 2).sum(axis=-1)).min(axis=1) < 0.0173
    assert (free[near, 0] <= probe.contacts[:, 0].max() + 1e-9).all()


def test_without_torques_the_foremost_part_of_the_hand_is_touched(
    log: Path, tmp_path: Path
) -> None:
    square = replace(HAND, boxes=(replace(HAND.boxes[0], rotation=(0.0, 0.0, 0.4)),))
    path = write_log(tmp_path / "log.mcap", torque=False)
    for file, torque in ((path, True), (log, False)):
        rig = replace(RIG, hand=square, forces=(replace(FORCES, torque=torque),))
        probe = read(file, rig)[1]
        in_hand = apply(inverse(hand_pose(2.0)), probe.contacts)
        assert len(in_hand) > 0
        corner = roll_pitch_yaw(np.array([0.0, 0.0, 0.4]))[:2, :2] @ [-0.02, 0.03]
        np.testing.assert_allclose(in_hand[:, :2], np.tile(corner, (len(in_hand), 1)), atol=1e-6)
        assert np.abs(in_hand[:, 2] - 0.1).max() < 0.0055


@pytest.mark.parametrize(
    ("changes", "contacts", "outside"),
    [
        ({"threshold": 7.0}, 0, 0),  # |FORCE| is 6.1 N
        ({"samples": 12}, 0, 0),  # there are 11 in a row
        ({"samples": 11}, 2, 0),
        ({"points": 1}, 1, 0),
        ({"acts": "by_hand", "points": 1}, 1, 0),  # the line then enters where it left
    ],
)
def test_settings_of_forces(
    log: Path, changes: dict[str, Any], contacts: int, outside: int
) -> None:
    session, probe, _ = read(log, replace(RIG, forces=(replace(FORCES, **changes),)))
    assert len(probe.contacts) == contacts
    assert session.report.total()["/wrench"].outside == outside
    in_hand = apply(inverse(hand_pose(2.0)), probe.contacts)
    assert (in_hand[:, 2] < 0.06).all() == (contacts == 0 or "acts" in changes)


def test_a_line_of_force_that_misses_the_hand_is_left_out(log: Path) -> None:
    thin = replace(HAND, boxes=(BoxRig((0.01, 0.01, 0.1), (0.0, 0.0, 0.05)),))
    for reach, outside in ((0.004, 11), (0.05, 0)):
        rig = replace(RIG, hand=thin, forces=(replace(FORCES, reach=reach),))
        session, probe, told = read(log, rig)
        assert session.report.total()["/wrench"].outside == outside
        assert ("11 out of reach" in told) == (outside == 11)
        assert (len(probe.contacts) == 0) == (outside == 11)


def test_a_log_without_markers_is_tared_by_its_beginning(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", marks=False)
    _, probe, told = read(path, replace(RIG, markers=None))
    assert len(probe.contacts) == 2
    assert "/wrench: nothing came before the first probe: its first 1 s are its tare" in told


def test_the_tare_is_of_the_last_seconds_before_a_probe_alone(log: Path, tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", settled=0.7)  # of the second before the probe
    brief = replace(RIG, forces=(replace(FORCES, tare=0.25),))
    found, expected = (read(file, brief)[1].contacts for file in (path, log))
    assert len(expected) == 2
    np.testing.assert_array_equal(found, expected)


def test_a_hand_alone_gives_free_space_and_annotated_contacts(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", forces=False)
    alone = replace(RIG, forces=())
    session, probe, _ = read(path, alone)
    assert (probe.outcome, len(probe.contacts)) == ("free", 0)
    assert len(probe.new_points.free) > 300
    assert list(session.report.total()) == ["hand"]
    extra = Annotations(exclude=(0,))
    assert len(read(path, replace(alone, annotations=extra))[1].contacts) == 0


def test_contacts_of_excluded_probes_are_left_out(log: Path) -> None:
    excluded = replace(RIG, annotations=Annotations(exclude=(0,)))
    assert len(read(log, excluded)[1].contacts) == 0


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    without = write_log(tmp_path / "log.mcap", forces=False)
    with pytest.raises(SessionError, match=r"lacks what rig pusher names: /wrench \(forces\)"):
        read(without)
    with pytest.raises(SettingError, match=r"forces need the solids of the hand.*hand\.boxes"):
        replace(RIG, hand=HandRig("hand"))
    with pytest.raises(SettingError, match=r"rig pusher has no sensor; accepted: .*clouds, hand"):
        read(without, replace(RIG, hand=None, forces=()))


def test_the_rig_to_start_from_is_read() -> None:
    values = yaml.safe_load((CONF / "session" / "rig" / "wrist_force.yaml").read_text())
    rig = build_settings(Rig, values, "session.rig")
    assert rig.forces == (ForceRig("/wrist/wrench"),)
    assert rig.hand is not None
