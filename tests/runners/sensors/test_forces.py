"""Rigs with a hand alone, and contacts that a force sensor in the wrist feels."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from chsel.errors import SessionError, SettingError
from chsel.problem.poses import apply, compose, inverse, roll_pitch_yaw
from chsel.problem.settings import build_settings
from runners.command.choices import CONF
from runners.sensors.rig import Annotations, BoxRig, ForceRig, HandRig, Rig
from runners.sensors.session_report import Counts
from runners.simulated_robot.log_writer import header, transform
from tests.runners.sensors import small_logs
from tests.runners.sensors.small_logs import BEGIN, SECOND, write_ros2, xyz

HAND = HandRig("hand", boxes=(BoxRig((0.04, 0.06, 0.1), (0.0, 0.0, 0.05)),))
FORCES = ForceRig("/wrench")
RIG = Rig(
    "pusher",
    "world",
    workspace=((0.2, 0.8), (-0.3, 0.3), (-0.1, 0.4)),
    boundary="none",
    hand=HAND,
    forces=(FORCES,),
    markers="/probe",
)
HAND_FROM_SENSOR = compose(roll_pitch_yaw(np.array([0.3, -0.2, 0.9])), np.array([0.0, 0.01, -0.06]))
WEIGHT = np.array([1.0, -2.0, 4.0, 0.3, 0.1, -0.2])  # of the hand, N and Nm, in the sensor's frame
TIP = np.array([0.012, -0.017, 0.1])  # m: where the hand is touched, in its frame
FORCE = np.array([1.0, -0.5, -6.0])  # N on the hand, with friction, in its frame


def hand_pose(seconds):
    """The hand goes along the world's x axis, which is its z axis, for a second, and back."""
    travel = max(0.0, 1.0 - abs(seconds - 2.0))
    forward = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    return compose(forward, np.array([0.3 + 0.1 * travel, 0.0, 0.1]))


def wrench(seconds):
    """Force and torque (6,) of a contact in the sensor's frame; it lasts for 0.1 s."""
    if abs(seconds - 2.0) >= 0.055 and abs(seconds - 1.5) > 1e-6:  # a spike
        return np.zeros(6)
    sensor_from_hand = inverse(HAND_FROM_SENSOR)
    force = sensor_from_hand[:3, :3] @ FORCE
    return np.concatenate([force, np.cross(apply(sensor_from_hand, TIP[None])[0], force)])


def write_log(path, *, torque=True, settled=0.0, lacks=""):
    """Four seconds at 100 Hz; lacks: a topic without messages.

    settled: seconds before which the sensor measures twice the hand's weight.
    """
    fixed = {
        "transforms": [transform("hand", "ft", parent_from_child=HAND_FROM_SENSOR, stamp=BEGIN)]
    }
    sent = [("/tf_static", "tf2_msgs/TFMessage", fixed, BEGIN)]
    for tick in range(401):
        seconds = tick * 0.01
        stamp = BEGIN + round(seconds * SECOND)
        moving = {
            "transforms": [
                transform("world", "hand", parent_from_child=hand_pose(seconds), stamp=stamp)
            ]
        }
        sent.append(("/tf", "tf2_msgs/TFMessage", moving, stamp))
        numbers = wrench(seconds) + WEIGHT * (2.0 if seconds < settled else 1.0)
        felt = {"force": xyz(*numbers[:3]), "torque": xyz(*(torque * numbers[3:]))}
        message = {"header": header("ft", stamp), "wrench": felt}
        sent.append(("/wrench", "geometry_msgs/WrenchStamped", message, stamp))
        if tick in (100, 300):
            text = {"data": "begin 0" if tick == 100 else "end 0"}
            sent.append(("/probe", "std_msgs/String", text, stamp))
    write_ros2(path, [one for one in sent if one[0] != lacks])
    return path


def test_forces_that_give_no_contact_are_told(tmp_path):
    path = write_log(tmp_path / "log.mcap")
    counts, _, told = read(path)
    assert counts.contacts > 0
    assert "/wrench: no" not in told
    counts, _, told = read(path, forces=(replace(FORCES, threshold=50.0),))
    largest = np.sqrt((FORCE**2).sum())
    assert f"no contact in 201 messages: their largest force is {largest:.3g} N, the thresh" in told
    elsewhere = HandRig("hand", boxes=(BoxRig((0.04, 0.06, 0.02), (0.0, 0.3, 0.05)),))
    counts, _, told = read(path, hand=elsewhere)
    assert counts.contacts == 0
    assert f"none of {counts.outside} lines of force meets the hand in the workspace" in told


def read(path, **changes):
    """What the forces gave, and what is known then; changes: of the rig."""
    session, (probe,), told = small_logs.read(path, replace(RIG, **changes))
    return session.report.total().get("/wrench", Counts()), probe, told


def in_hand(probe):
    """Contacts (C, 3) in the hand's frame at its furthest."""
    return apply(inverse(hand_pose(2.0)), probe.contacts)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("log") / "log.mcap")


def test_a_contact_is_where_the_line_of_force_enters_the_hand(log):
    counts, probe, told = read(log)
    assert len(probe.contacts) == counts.contacts == 2  # 10 mm of way are two voxels of 5 mm
    np.testing.assert_allclose(in_hand(probe)[:, :2], np.tile(TIP[:2], (2, 1)), atol=1e-5)
    ahead = in_hand(probe)[:, 2]
    assert ((ahead > TIP[2] - 0.0055) & (ahead < TIP[2] + 1e-6)).all()
    np.testing.assert_allclose(probe.contact_normals, [[-1.0, 0.0, 0.0]] * 2, atol=1e-6)
    assert probe.outcome == "contact"
    assert (counts.images, counts.used, counts.spikes) == (401, 201, 1)  # the spike
    assert "/wrench: left out of 401 messages: 1 of forces that do not last" in told
    # Free space is what the hand swept, and none behind the contact.
    free = probe.new_points.free
    assert len(free) > 300
    assert free[:, 0].max() > hand_pose(2.0)[0, 3] + 0.1 - 0.01
    near = np.sqrt(((free[:, None] - probe.contacts) ** 2).sum(axis=-1)).min(axis=1) < 0.0173
    assert (free[near, 0] <= probe.contacts[:, 0].max() + 1e-9).all()


def test_without_torques_the_foremost_part_of_the_hand_is_touched(log, tmp_path):
    square = replace(HAND, boxes=(replace(HAND.boxes[0], rotation=(0.0, 0.0, 0.4)),))
    path = write_log(tmp_path / "log.mcap", torque=False)
    corner = roll_pitch_yaw(np.array([0.0, 0.0, 0.4]))[:2, :2] @ [-0.02, 0.03]
    for file, torque in ((path, True), (log, False)):
        places = in_hand(read(file, hand=square, forces=(replace(FORCES, torque=torque),))[1])
        assert len(places) > 0
        np.testing.assert_allclose(places[:, :2], np.tile(corner, (len(places), 1)), atol=1e-6)
        assert np.abs(places[:, 2] - 0.1).max() < 0.0055


@pytest.mark.parametrize(
    ("changes", "contacts"),
    [
        ({"threshold": 7.0}, 0),  # |FORCE| is 6.1 N
        ({"samples": 12}, 0),  # there are 11 in a row
        ({"samples": 11}, 2),
        ({"points": 1}, 1),
        ({"acts": "by_hand", "points": 1}, 1),  # the line then enters where it left
    ],
)
def test_settings_of_forces(log, changes, contacts):
    counts, probe, _ = read(log, forces=(replace(FORCES, **changes),))
    assert (len(probe.contacts), counts.outside) == (contacts, 0)
    assert (in_hand(probe)[:, 2] < 0.06).all() == (contacts == 0 or "acts" in changes)


@pytest.mark.parametrize(("acts", "sign"), [("on_hand", 1.0), ("by_hand", -1.0)])
def test_the_normal_of_a_contact_is_the_direction_of_the_force_on_the_hand(log, acts, sign):
    forces = replace(FORCES, normals=20, acts=acts)
    probe = read(log, forces=(forces,))[1]
    unit = hand_pose(2.0)[:3, :3] @ FORCE / np.sqrt((FORCE**2).sum())
    count = len(probe.contacts)
    assert count > 0
    np.testing.assert_allclose(probe.new_points.normals, [sign * unit] * count, atol=1e-6)
    np.testing.assert_allclose(probe.new_points.normal_noise, np.pi / 9)
    before = read(log, forces=(replace(FORCES, acts=acts),))[1]
    assert not before.new_points.has_normals
    np.testing.assert_array_equal(probe.contact_normals, before.contact_normals)
    np.testing.assert_array_equal(probe.new_points.known, before.new_points.known)
    np.testing.assert_array_equal(probe.new_points.free, before.new_points.free)


def test_a_corner_of_the_hand_on_a_slope_gives_the_normal_of_the_slope(tmp_path, monkeypatch):
    """The hand's face there is 30 degrees off the slope, which has no friction."""
    slope = np.array([0.5, 0.0, -np.sqrt(0.75)])  # out of the object, in the hand's frame
    monkeypatch.setattr("tests.runners.sensors.test_forces.FORCE", 7.0 * slope)
    monkeypatch.setattr("tests.runners.sensors.test_forces.TIP", np.array([-0.02, 0.01, 0.1]))
    path = write_log(tmp_path / "log.mcap")
    probe = read(path, forces=(replace(FORCES, normals=20),))[1]
    outward = hand_pose(2.0)[:3, :3] @ slope
    assert len(probe.contacts) > 0
    cosines = probe.new_points.normals @ outward
    assert cosines.min() > 1.0 - 1e-9
    assert (probe.contact_normals @ outward).max() < 0.9


def test_a_line_of_force_that_misses_the_hand_is_left_out(log):
    thin = replace(HAND, boxes=(BoxRig((0.01, 0.01, 0.1), (0.0, 0.0, 0.05)),))
    for reach, outside in ((0.004, 11), (0.05, 0)):
        counts, probe, told = read(log, hand=thin, forces=(replace(FORCES, reach=reach),))
        assert counts.outside == outside
        assert ("11 out of reach" in told) == (len(probe.contacts) == 0) == (outside == 11)


def test_the_tare_is_of_the_last_seconds_before_a_probe_or_of_the_first(log, tmp_path):
    unmarked = write_log(tmp_path / "unmarked.mcap", lacks="/probe")
    _, probe, told = read(unmarked, markers=None)
    assert len(probe.contacts) == 2
    assert "/wrench: nothing came before the first probe: its first 1 s are its tare" in told
    path = write_log(tmp_path / "log.mcap", settled=0.7)  # of the second before the probe
    brief = replace(FORCES, tare=0.25)
    found, expected = (read(file, forces=(brief,))[1].contacts for file in (path, log))
    assert len(expected) == 2
    np.testing.assert_array_equal(found, expected)


def test_a_hand_alone_gives_free_space(log, tmp_path):
    without = write_log(tmp_path / "log.mcap", lacks="/wrench")
    _, probe, _ = read(without, forces=())
    assert (probe.outcome, len(probe.contacts)) == ("free", 0)
    assert len(probe.new_points.free) > 300
    assert len(read(log, annotations=Annotations(exclude=(0,)))[1].contacts) == 0
    with pytest.raises(SessionError, match=r"lacks what rig pusher names: /wrench \(forces\)"):
        read(without)
    with pytest.raises(SettingError, match=r"forces need the solids of the hand.*hand\.boxes"):
        replace(RIG, hand=HandRig("hand"))


def test_the_rig_to_start_from_is_read():
    values = yaml.safe_load((CONF / "session" / "rig" / "wrist_force.yaml").read_text())
    rig = build_settings(Rig, values, where="session.rig")
    assert rig.forces == (ForceRig("/wrist/wrench"),)
