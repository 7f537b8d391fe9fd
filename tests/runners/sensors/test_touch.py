"""A gel that is pressed against a box, in a log and in a file of points."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.errors import PointsError, SessionError
from chsel.problem.poses import compose, roll_pitch_yaw
from chsel.sensing.touch_image import touch_points
from runners.objects.loader import ObjectModel
from runners.sensors.rig import Rig, TouchRig
from runners.sessions.points import PointsSettings, PointsSource, read_points
from runners.simulated_robot.log_writer import image, transform
from tests.runners.sensors.small_logs import BEGIN, SECOND, read, write_ros2

PIXEL = 0.0002
SHAPE = (40, 50)
POSE = compose(roll_pitch_yaw(np.array([0.4, -0.2, 0.9])), np.array([0.4, 0.1, 0.2]))
TOUCH = TouchRig("finger", "/height", PIXEL, unit=1e-6, normals=3.0)
RIG = Rig(
    "gel",
    "world",
    workspace=((0.2, 0.8), (-0.3, 0.3), (0.0, 0.4)),
    boundary="none",
    touches=(TOUCH,),
    surface_resolution=0.002,
)
BOX = ObjectModel(
    "box", trimesh.creation.box((0.03, 0.04, 0.12)), scale=1.0, epsilon=0.001, configuration="box"
)


def slope(deepest):
    """Heights (H, W), metres, of a plane that falls off along x from the left."""
    columns = np.indices(SHAPE)[1] + 0.3
    return np.maximum(deepest - 0.2 * PIXEL * columns, 0.0)


def write_log(path, *, unit=1e-6, dtype=np.uint16, deepest=(0.0002, 0.0011, 0.0006)):
    """Three images, of which the second is pressed in most."""
    sent = []
    for n, depth in enumerate(deepest):
        stamp = BEGIN + n * SECOND // 10
        moved = {"transforms": [transform("world", "gel", parent_from_child=POSE, stamp=stamp)]}
        sent.append(("/tf", "tf2_msgs/TFMessage", moved, stamp))
        values = slope(depth) / unit
        values = np.rint(values).astype(dtype) if dtype == np.uint16 else values.astype(dtype)
        sent.append(("/height", "sensor_msgs/Image", image("gel", values, stamp=stamp), stamp))
    write_ros2(path, sent)
    return path


@pytest.mark.parametrize(
    ("unit", "dtype", "rig"),
    [
        (1e-6, np.uint16, TOUCH),
        (1.0, np.float32, replace(TOUCH, unit=None)),
    ],
)
def test_contacts_are_those_of_the_image_that_is_pressed_in_most(tmp_path, unit, dtype, rig):
    path = write_log(tmp_path / "log.mcap", unit=unit, dtype=dtype)
    session, (probe,), _ = read(path, replace(RIG, touches=(rig,)))
    height = slope(0.0011)
    expected = touch_points(
        height, height > 1e-4, pixel=PIXEL, world_from_sensor=POSE, spacing=0.002
    )
    points = probe.new_points
    order = np.lexsort(points.known.T)
    wanted = np.lexsort(expected.points.T)
    np.testing.assert_allclose(points.known[order], expected.points[wanted], atol=2e-6)
    known = points.normal_noise[order] > 0.0
    assert 0 < known.sum() < len(known)
    np.testing.assert_allclose(points.normal_noise[order][known], np.radians(3.0))
    normal = POSE[:3, :3] @ np.array([0.2, 0.0, -1.0]) / np.hypot(0.2, 1.0)  # out of the object
    assert (points.normals[order][known] @ normal).min() > np.cos(np.radians(1.0))
    assert session.report.total()["finger"].touching == int((height > 1e-4).sum())


def test_heights_need_a_unit_and_a_touch(tmp_path):
    path = write_log(tmp_path / "log.mcap")
    with pytest.raises(SessionError, match="heights of finger are integers, whose unit is not"):
        read(path, replace(RIG, touches=(replace(TOUCH, unit=None),)))
    _, (probe,), told = read(path, replace(RIG, touches=(replace(TOUCH, threshold=0.002),)))
    assert len(probe.new_points.known) == 0
    assert "finger: no contact in 3 images: a gel is pressed in by 1.09 mm at most" in told
    _, (probe,), told = read(path, replace(RIG, touches=(replace(TOUCH, unit=1e-3),)))
    assert "finger: height is from" in told
    assert len(probe.new_points.known) == 0


def test_a_file_of_points_may_have_touch_images(tmp_path):
    path = tmp_path / "points.npz"
    heights = np.stack([slope(0.0011), slope(0.0006)])
    poses = np.stack([POSE, compose(np.eye(3), np.array([0.0, 0.0, 0.05])) @ POSE])
    arrays = {"touch_height": heights, "touch_pose": poses, "touch_pixel": PIXEL}
    np.savez(path, **arrays, touch_step=np.array([0, 3]), free=np.full((2, 3), 0.3))
    found = read_points(path, normal_noise=0.1)
    expected = [
        touch_points(height, pixel=PIXEL, world_from_sensor=pose)
        for height, pose in zip(heights, poses, strict=True)
    ]
    for step, touch in zip((0, 3), expected, strict=True):
        points = found.at(step)
        np.testing.assert_array_equal(points.known, touch.points)
        np.testing.assert_array_equal(points.normals, touch.normals)
        np.testing.assert_array_equal(points.normal_noise, 0.1 * touch.normals.any(axis=1))
    assert not read_points(path).at(0).normals.any()
    session = PointsSource(PointsSettings(str(path)), BOX)
    assert "normals, which are not used" in str(session.warnings[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"touch_pixel": None}, "touch_pixel is missing"),
        ({"touch_pose": np.eye(4)[None]}, "touch_pose has shape"),
        ({"touch_height": np.zeros((2, *SHAPE))}, "touch image 0: no pixel is in contact"),
        ({"touch_height": np.full((2, *SHAPE), 0.5)}, "touch image 0: height is from 0.5"),
        ({"touch_step": np.array([0.5, 1.0])}, "touch_step"),
        ({"touch_contact": np.ones((1, *SHAPE), bool)}, "touch_contact has 1 images"),
    ],
)
def test_malformed_touch_images_are_one_line(tmp_path, changes, message):
    path = tmp_path / "points.npz"
    arrays = {
        "touch_height": np.stack([slope(0.0011)] * 2),
        "touch_pose": np.stack([POSE] * 2),
        "touch_pixel": PIXEL,
        **changes,
    }
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(PointsError, match=rf"point file .*{message}"):
        read_points(path)
