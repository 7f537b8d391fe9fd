"""The tree of transforms: interpolation, gaps, and trees that are none; joints over time."""

from types import SimpleNamespace

import numpy as np
import pytest

from chsel.problem.poses import axis_angle, compose, inverse, random_rotations, rotation_angle
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.decoding import rigid
from runners.sensors.log.messages import Received, TransformMessage
from runners.sensors.log.motion import MotionLimits
from runners.sensors.log.transforms import (
    MOST_OF_A_PROBE,
    JointHistory,
    TransformError,
    TransformTree,
)

SECOND = 10**9
X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def pose(x=0.0, angle=0.0, *, axis=Z):
    return compose(axis_angle(axis, angle), np.array([x, 0.0, 0.0]))


def tree(*transforms, static=False):
    """Transforms at seconds."""
    made = TransformTree()
    for seconds, *parts in transforms:
        message = TransformMessage(*parts, static=static)
        made.add(Received("/tf", int(seconds * SECOND), stamp=None, content=message), message)
    made.settle(ClockCorrection())
    return made


def test_between_samples_it_goes_straight_and_along_the_shorter_arc():
    start, end = 3.0, 3.0 - 2 * np.pi + 0.5  # 0.5 rad further, the long way round as numbers
    moving = tree((1, "a", "b", pose(0.0, start)), (2, "a", "b", pose(1.0, end)))
    for time, x, angle in ((1.0, 0.0, 3.0), (1.5, 0.5, 3.25), (1.9, 0.9, 3.45), (2.0, 1.0, 3.5)):
        found = moving.lookup("a", "b", stamp_ns=int(time * SECOND), gap_s=1.0)
        np.testing.assert_allclose(found, pose(x, angle), atol=1e-12)
        back = moving.lookup("b", "a", stamp_ns=int(time * SECOND), gap_s=1.0)
        np.testing.assert_allclose(back, inverse(pose(x, angle)), atol=1e-12)
    first, second = random_rotations(np.random.default_rng(2), 2)
    made = tree(*((k, "a", "b", compose(r, np.zeros(3))) for k, r in enumerate((first, second))))
    found = made.lookup("a", "b", stamp_ns=int(0.1 * SECOND), gap_s=1.0)
    expected = 0.1 * rotation_angle(first.T @ second)
    np.testing.assert_allclose(rotation_angle(first.T @ found[:3, :3]), expected, atol=1e-12)


def test_a_chain_joins_static_and_moving_frames_over_their_common_root():
    camera = pose(0.5, 0.3, axis=X)
    turned = pose(1.0, np.pi / 2)
    made = tree(
        *((time, "world", "arm", turned) for time in (0, 1)),
        (0, "world", "stand", pose(-1.0)),
        (1, "world", "stand", pose(-3.0)),
    )
    static = TransformMessage("arm", "camera", parent_from_child=camera, static=True)
    made.add(Received("/tf_static", 0, stamp=None, content=static), static)
    found = made.lookup("stand", "camera", stamp_ns=SECOND // 2, gap_s=1.0)
    np.testing.assert_allclose(found, inverse(pose(-2.0)) @ turned @ camera, atol=1e-12)
    np.testing.assert_array_equal(made.lookup("arm", "arm", stamp_ns=5, gap_s=1.0), np.eye(4))


def test_order_and_repetition_do_not_matter():
    random = np.random.default_rng(0)
    samples = [(i / 10, "a", "b", pose(random.normal(), 3 * random.normal())) for i in range(30)]
    mixed = [samples[i] for i in random.permutation(30)] + samples[5:9]
    stamps = random.integers(0, 29 * SECOND // 10, 50)
    expected, all_valid = tree(*samples).lookups("a", "b", stamps_ns=stamps, gap_s=0.2)
    found, valid = tree(*mixed).lookups("a", "b", stamps_ns=stamps, gap_s=0.2)
    assert (all_valid & valid).all()
    np.testing.assert_array_equal(found, expected)


def test_stamps_of_a_clock_that_is_ahead_are_put_right():
    made = TransformTree()
    ahead = 90 * SECOND
    for time in (SECOND, 2 * SECOND):
        for topic, child, stamp in (("/tf", "b", time + ahead), ("/arm", "c", time)):
            message = TransformMessage("a", child, parent_from_child=pose(time / SECOND))
            made.add(Received(topic, time + 5, stamp=stamp, content=message), message)
    made.settle(ClockCorrection({"/tf": -ahead}))
    assert made.times.tolist() == [SECOND, 2 * SECOND]
    found = made.lookup("b", "c", stamp_ns=3 * SECOND // 2, gap_s=1.0)
    np.testing.assert_allclose(found, pose(0.0), atol=1e-12)


def test_gaps_and_ends_are_bridged_as_far_as_told():
    made = tree(*((time, "a", "b", pose(time)) for time in (1.0, 1.4, 3.0)))
    times = np.array([0.4, 0.6, 1.2, 1.4, 1.5, 2.9, 3.0, 3.5, 3.6])
    stamps = (times * SECOND).astype(np.int64)
    poses, valid = made.lookups("a", "b", stamps_ns=stamps, gap_s=0.5)
    assert valid.tolist() == [False, True, True, True, False, False, True, True, False]
    np.testing.assert_allclose(poses[valid][:, 0, 3], [1.0, 1.2, 1.4, 3.0, 3.0])
    assert np.isnan(poses[~valid]).all()
    with pytest.raises(TransformError, match=r"b in a is not known at 2\.500 s; .* 0\.500 s after"):
        made.lookup("a", "b", stamp_ns=int(2.5 * SECOND), gap_s=0.5)
    with pytest.raises(TransformError, match=r"not known at 4\.000 s; .* 1\.000 s before"):
        made.lookup("a", "b", stamp_ns=4 * SECOND, gap_s=0.5)


def test_what_is_missing_is_said():
    made = tree((0, "world", "arm", pose()), (0, "map", "camera", pose()))
    with pytest.raises(TransformError, match="frame wrist is in no transform; there are arm, cam"):
        made.lookup("world", "wrist", stamp_ns=0, gap_s=1.0)
    trees = "world: arm, world; map: camera, map"
    with pytest.raises(TransformError, match=f"world and camera are not connected.*{trees}"):
        made.lookup("world", "camera", stamp_ns=0, gap_s=1.0)
    with pytest.raises(TransformError, match="there are none"):
        TransformTree().lookup("a", "b", stamp_ns=0, gap_s=1.0)


def test_contradictions_are_faults():
    """Of parents the first counts, of static places the latest."""
    made = tree(
        (0, "a", "b", pose(1.0)),
        (0, "b", "c", pose(2.0)),
        (1, "x", "c", pose(5.0)),
        (1, "c", "a", pose(5.0)),
        (1, "d", "d", pose(5.0)),
    )
    assert made.faults == {
        "frame c has two parents, b and x": 1,
        "frame a is its own ancestor, by way of c": 1,
        "frame d is its own ancestor, by way of d": 1,
    }
    np.testing.assert_allclose(made.lookup("a", "c", stamp_ns=0, gap_s=1.0), pose(3.0))
    places = ((5, 1.0), (9, 2.0), (7, 3.0), (9, 2.0))
    made = tree(*((time, "a", "b", pose(x)) for time, x in places), static=True)
    np.testing.assert_allclose(made.lookup("a", "b", stamp_ns=10**18, gap_s=0.1), pose(2.0))
    assert made.faults == {"frame b is static in several places": 2}


def test_quaternions_of_any_length_are_rotations():
    for angle in (0.0, 1.2, np.pi):
        for axis in np.eye(3):
            x, y, z = np.sin(angle / 2) * 1e300 * axis
            turn = SimpleNamespace(x=x, y=y, z=z, w=np.cos(angle / 2) * 1e300)
            found = rigid(SimpleNamespace(x=1.0, y=0.0, z=0.0), turn)
            np.testing.assert_allclose(found, pose(1.0, angle, axis=axis), atol=1e-14)


def history(*positions):
    """Positions at times 0, 10, 20, ..."""
    joints = JointHistory(["finger"])
    for index, values in enumerate(positions):
        joints.add(Received("/joints", 10 * index, stamp=None, content=""), values)
    joints.settle(ClockCorrection(), MotionLimits(3.0, 10.0))
    return joints


def test_a_state_of_the_joints_holds_until_the_next():
    moved = [0.1 if time >= 500 else 0.001 * (time % 20) for time in range(0, 1000, 10)]
    joints = history(*({"finger": value, "elbow": 10.0 * n} for n, value in enumerate(moved)))
    assert joints.first() == {"finger": 0.0}
    assert joints.during(100, 400) == [(100, {"finger": 0.0})]
    assert joints.during(400, 600) == [(400, {"finger": 0.0}), (500, {"finger": 0.1})]
    assert joints.during(600, 700) == [(600, {"finger": 0.1})]
    assert history().during(0, 9) == [(0, {})]
    busy = history(*({"finger": float(time)} for time in range(1000)))
    assert len(busy.during(0, 10_000)) <= MOST_OF_A_PROBE
