"""Motions that no robot makes: outliers, jumps, and publishers that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import SessionError
from chsel.problem.poses import axis_angle, compose
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import Received
from runners.sensors.log.motion import MotionLimits, check_motion
from runners.sensors.log.transforms import JointHistory
from runners.sensors.rig import BoxRig, HandRig, Rig
from runners.simulated_robot.log_writer import joint_state, transform
from tests.runners.sensors.small_logs import BEGIN, SECOND, read, write_ros2

RIG = Rig(
    "stick",
    "base",
    workspace=((0.0, 1.0), (-0.5, 0.5), (0.0, 0.6)),
    boundary="none",
    hand=HandRig("tool0", boxes=(BoxRig((0.02, 0.02, 0.02)),)),
)
LIMITS = MotionLimits(3.0, 10.0)
THERE = np.array([0.2, 0.0, 0.3])
ASIDE = np.array([0.3, 0.2, 0.1])


def straight(start=THERE, count=101, *, begin=0.0):
    """Seconds and positions of a hand that goes 0.1 m along x in 2 s."""
    return [
        (begin + 0.02 * n, np.add(start, [0.1 * n / (count - 1), 0.0, 0.0])) for n in range(count)
    ]


WAY = straight()


def moved(samples, by):
    return [(seconds, place + by) for seconds, place in samples]


def swept(path, samples, *, topic="/tf", stamps=None):
    """Free voxels of samples, positions or poses, and what was told."""
    sent = []
    for seconds, place in samples:
        pose = place if np.ndim(place) == 2 else compose(np.eye(3), np.array(place, dtype=float))
        log_time = BEGIN + round(seconds * SECOND)
        stamp = log_time if stamps is None else BEGIN + round(stamps(seconds) * SECOND)
        moving = transform("base", "tool0", parent_from_child=pose, stamp=stamp)
        if topic == "/tf":
            sent.append((topic, "tf2_msgs/TFMessage", {"transforms": [moving]}, log_time))
        else:
            sent.append((topic, "geometry_msgs/TransformStamped", moving, log_time))
    write_ros2(path / "log.mcap", sorted(sent, key=lambda one: one[3]))
    session, probes, _ = read(path / "log.mcap", RIG)
    free = np.concatenate([probe.new_points.free for probe in probes])
    told = [text for level, text in session.report.lines if level == "warning"]
    return {tuple(voxel) for voxel in np.rint(1000 * free).astype(int).tolist()}, "\n".join(told)


@pytest.fixture(scope="module")
def way(tmp_path_factory):
    free, told = swept(tmp_path_factory.mktemp("way"), WAY)
    assert (len(free), told) == (24, "")
    return free


@pytest.mark.parametrize("place", [np.zeros(3), THERE + ASIDE])
@pytest.mark.parametrize("lost", [[50, 51, 52], [0, 1, 2], [20], [40, 60, 61, 80]])
def test_what_a_tracker_sends_without_a_target_is_left_out(tmp_path, way, place, lost):
    samples = [(s, place if n in lost else at) for n, (s, at) in enumerate(WAY)]
    free, told = swept(tmp_path, samples)
    assert free == way
    assert f"or more suddenly than any arm: {len(lost)} of 101 sam" in told


@pytest.mark.parametrize("lost", [[50], [50, 51], [50, 51, 52], [20, 21, 70, 71, 72]])
def test_a_short_visit_close_by_is_left_out(tmp_path, way, lost):
    """50 mm in 20 ms are 2.5 m/s, below the limit, from a stand and to one."""
    aside = np.array([0.0, 0.05, 0.0])
    samples = [(s, at + aside if n in lost else at) for n, (s, at) in enumerate(WAY)]
    free, told = swept(tmp_path, samples)
    assert free == way
    assert f"{len(lost)} of 101 samples are left out" in told


def test_a_rotation_that_flips_is_left_out(tmp_path, way):
    turned = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 2.0), THERE)
    free, told = swept(tmp_path, [*WAY[:50], (WAY[50][0], turned), *WAY[51:]])
    assert free == way
    assert "tool0 in base, on /tf, goes there and back faster" in told


@pytest.mark.parametrize("aside", [0.015, 0.05, 0.4])
@pytest.mark.parametrize("later", [0.0, 0.01])
def test_two_publishers_that_alternate_are_named(tmp_path, way, aside, later):
    """later: seconds between their stamps."""
    other = [(seconds + later, place + np.array([0.0, aside, 0.0])) for seconds, place in WAY]
    said = r"tool0 in base, on /tf, alternates between places .* two publishers .*: 202 of 202 sam"
    with pytest.raises(SessionError, match=said):
        swept(tmp_path, [*WAY, *other])
    # What was sent before the other one is used.
    free, told = swept(tmp_path, [*WAY, *[one for one in other if one[0] > 1.0]])
    assert free < way
    assert len(free) >= 8
    assert "alternates between places" in told


def test_a_second_publisher_that_sends_less_is_left_out(tmp_path, way):
    free, told = swept(tmp_path, [*WAY, *[(s + 0.007, THERE + ASIDE) for s, _ in WAY[::4]]])
    assert free == way
    assert "26 of 127 samples are left out, perhaps those of a second publisher" in told


def test_nothing_is_swept_across_a_jump(tmp_path):
    first, told = swept(tmp_path, WAY[:50])
    assert told == ""
    second, _ = swept(tmp_path, moved(WAY[50:], ASIDE))
    free, told = swept(tmp_path, [*WAY[:50], *moved(WAY[50:], ASIDE)])
    assert free == first | second
    assert "tool0 in base, on /tf, jumps, faster than 3 m/s or 10 rad/s" in told
    third, _ = swept(tmp_path, moved(WAY[75:], -ASIDE))
    samples = [*WAY[:50], *moved(WAY[50:75], ASIDE), *moved(WAY[75:], -ASIDE)]
    free, told = swept(tmp_path, samples)
    assert first | third <= free
    assert len(free) < len(first | second | third) + 1
    assert "swept across 2 gaps" in told


@pytest.mark.parametrize(("rate", "speed"), [(1000, 2.9), (50, 2.9), (10, 2.5), (4, 2.0)])
def test_a_fast_robot_is_no_fault(tmp_path, rate, speed):
    """It goes to and fro over 0.4 m, or 0.1 m, of whose ends each is sampled once."""
    count = max(round(0.4 / speed * rate), 1)
    places = [abs((n + count) % (2 * count) - count) / count for n in range(8 * count + 1)]
    stroke = np.array([0.1 if rate == 4 else 0.4, 0.0, 0.0])
    samples = [(n / rate, THERE + place * stroke) for n, place in enumerate(places)]
    free, told = swept(tmp_path, samples)
    assert told == ""
    xs = sorted({x for x, _, _ in free})
    assert np.diff(xs).max() == 10
    assert xs[-1] - xs[0] >= (90 if rate == 4 else 390)


@pytest.mark.parametrize(
    ("rate", "frequency", "amplitude"),
    [(50, 5.0, 0.03), (60, 5.0, 0.03), (50, 2.5, 0.073), (25, 1.75, 0.165), (30, 5.0, 0.02)],
)
@pytest.mark.parametrize("phase", [0.0, 0.2])
def test_a_hand_that_taps_keeps_its_turning_points(rate, frequency, amplitude, phase):
    """Of sines of up to 30 m/s^2, no sample is left out."""
    seconds = np.arange(6 * rate) / rate
    places = amplitude * np.sin(2.0 * np.pi * frequency * seconds + phase)
    assert np.abs(amplitude * (2.0 * np.pi * frequency) ** 2) <= 30.0

    def distances(one, other):
        away = np.abs(places[one] - places[other])
        return np.stack([away, np.zeros_like(away)], axis=1)

    motion = check_motion(np.rint(seconds * SECOND).astype(np.int64), distances, limits=LIMITS)
    assert motion.kept.all()
    assert not motion.jumps.any()


def test_stamps_that_start_again_are_later_times(tmp_path, way):
    again = straight(THERE + ASIDE, begin=4.0)
    alone, _ = swept(tmp_path, again)
    both = [*WAY, *again]
    free, told = swept(tmp_path, both, stamps=lambda s: s - 100.0 - (3.997 if s >= 4.0 else 0.0))
    assert free == way | alone
    assert "stamps on /tf start again or jump against the log's clock, by -3.997 s" in told
    assert "stamps are 100 s behind the log's clock" in told
    assert "all alike" not in told


@pytest.mark.parametrize("step", [-4.4, 4.4])
def test_a_clock_that_steps_is_put_right(tmp_path, way, step):
    free, told = swept(tmp_path, WAY, stamps=lambda s: s + 10.0 + (step if s > 1.0 else 0.0))
    assert free == way
    assert f"by {step:+g} s: each part is shifted" in told


def test_two_topics_of_one_transform_are_both_named(tmp_path):
    sent = []
    for topic, samples in (("/tf_arm", WAY), ("/tf_mocap", moved(WAY, ASIDE))):
        for seconds, place in samples:
            time = BEGIN + round(seconds * SECOND)
            message = transform(
                "base", "tool0", parent_from_child=compose(np.eye(3), place), stamp=time
            )
            sent.append((topic, "geometry_msgs/TransformStamped", message, time))
    write_ros2(tmp_path / "log.mcap", sorted(sent, key=lambda one: one[3]))
    with pytest.raises(SessionError, match="on /tf_arm and /tf_mocap, alternates between places"):
        read(tmp_path / "log.mcap", RIG)


def history(*positions, sliding=("finger",), every=0.02):
    """Positions of a joint at multiples of `every` seconds, and warnings about them."""
    joints = JointHistory(["finger"], sliding)
    for index, value in enumerate(positions):
        time = round(index * every * SECOND)
        joints.add(Received("/joint_states", time, stamp=None, content=""), {"finger": value})
    return joints, joints.settle(ClockCorrection(), LIMITS)


def states(joints):
    return [state and state["finger"] for _, state in joints.during(0, 10**12)]


def test_a_joint_that_is_elsewhere_for_once_is_left_out():
    joints, told = history(*[0.04] * 50, 0.0, *[0.04] * 50)
    assert set(states(joints)) == {0.04}
    assert "the hand's joints, on /joint_states, goes there and back faster" in told[0]
    joints, told = history(*np.linspace(0.04, 0.0, 101))
    assert (len(told), states(joints)[-1]) == (0, pytest.approx(0.0, abs=0.01))
    joints, told = history(*[0.1, 0.1 - 2 * np.pi] * 20, sliding=())  # a full turn apart
    assert told == []


def test_two_nodes_that_send_one_joint_leave_it_unknown():
    joints, told = history(*[0.04] * 50, *[0.04, 0.0] * 50)
    assert states(joints) == [0.04, None]
    assert "alternates between places" in told[0]
    joints, told = history(*[0.04, 0.0] * 50)
    assert states(joints) == [None]
    assert joints.first() == {}


URDF = """<robot name="g"><link name="palm"/><link name="tip"><collision><geometry>
<box size="0.02 0.02 0.02"/></geometry></collision></link><joint name="finger" type="prismatic">
<parent link="palm"/><child link="tip"/><axis xyz="0 1 0"/></joint></robot>"""


def test_a_hand_whose_joints_are_unknown_sweeps_nothing(tmp_path):
    pytest.importorskip("yourdfpy")
    (tmp_path / "hand.urdf").write_text(URDF)
    hand = HandRig("tool0", urdf=str(tmp_path / "hand.urdf"), joints="/joint_states")
    free, told = {}, {}
    for name, others in (("one", ()), ("two", (0.1,))):
        sent = []
        for seconds, place in WAY:
            time = BEGIN + round(seconds * SECOND)
            moving = transform(
                "base", "tool0", parent_from_child=compose(np.eye(3), place), stamp=time
            )
            sent.append(("/tf", "tf2_msgs/TFMessage", {"transforms": [moving]}, time))
            for number, value in enumerate((0.0, *others)):
                states = joint_state(
                    ["wheel", "finger"], [np.nan, value], stamp=time + number * 10**7
                )
                sent.append(("/joint_states", "sensor_msgs/JointState", states, time))
        write_ros2(tmp_path / "log.mcap", sent)
        session, probes, told[name] = read(tmp_path / "log.mcap", replace(RIG, hand=hand))
        free[name] = np.concatenate([probe.new_points.free for probe in probes])
    assert len(free["one"]) == 24
    assert "joints" not in told["one"]
    assert len(free["two"]) == 0
    assert "the hand's joints, on /joint_states, alternates between places" in told["two"]
    counts = session.report.total()["hand"]
    assert (counts.images, counts.lost, counts.used) == (101, 101, 0)
    assert "hand: none of its 101 messages was of use: 101 without a pose" in told["two"]


def test_a_value_that_is_nan_leaves_the_joint_where_it_was():
    joints = JointHistory(["finger", "wrist"])
    for time, finger in ((0, 0.04), (SECOND, float("nan"))):
        positions = {"wheel": float("nan"), "finger": finger, "wrist": time / SECOND}
        joints.add(Received("/joints", time, stamp=None, content=""), positions)
    assert joints.settle(ClockCorrection(), LIMITS) == []
    assert joints.during(0, 2 * SECOND)[-1][1] == {"finger": 0.04, "wrist": 1.0}
    said = "/joints: joint finger is not a finite number; it counts as unmoved"
    assert joints.faults == {said: 1}


def test_of_poses_at_random_next_to_nothing_is_swept(tmp_path):
    random = np.random.default_rng(0)
    samples = [(0.02 * n, random.uniform([0, -0.5, 0], [1, 0.5, 0.6])) for n in range(60)]
    free, told = swept(tmp_path, samples)
    assert len(free) < 40  # of 60 hands of eight voxels
    assert "samples are left out" in told
