"""What sensors measured of something else, or wrongly, does not become points of the object."""

from dataclasses import replace

import numpy as np
import pytest

from runners.sensors.rig import CloudRig, GateRig, Rig
from runners.simulated_robot.log_writer import transform
from tests.runners.sensors import sphere_log
from tests.runners.sensors.small_logs import BEGIN, read, ros2_cloud, write_ros2
from tests.runners.sensors.sphere_log import CENTRE, MEMBRANE, RADIUS, RIG, SphereLog, heights

PLAIN_MEMBRANE = sphere_log.membrane
WITHOUT = GateRig(jump=1e6, part=0.0, speckle=0)


@pytest.mark.parametrize("kind", ["depth", "deformation"])
def test_pixels_of_a_pad_that_jump_are_no_contact(tmp_path, monkeypatch, kind):
    """Of deformations, neither are those beside, to which the mean filter would spread them."""

    def spoilt(hand):
        depth = PLAIN_MEMBRANE(hand)
        if hand[0, 3] > 0.7 or kind == "deformation":
            depth[2:7, 40:45] = 0.02  # a reflection, 40 mm before the membrane at all times
        return depth if kind == "depth" else MEMBRANE - depth

    monkeypatch.setattr(sphere_log, "membrane", spoilt)
    log = SphereLog().write(tmp_path / "log.mcap")
    pad = RIG.bubbles[0]
    if kind == "deformation":
        np.save(tmp_path / "untouched.npy", np.full((36, 48), MEMBRANE))
        pad = replace(pad, kind=kind, reference=str(tmp_path / "untouched.npy"))
    rig = replace(RIG, bubbles=(pad,))
    session, (touching, passing), told = read(log, rig)
    assert (len(touching.contacts), len(passing.contacts)) == (50, 0)
    assert np.abs(heights(touching.contacts)).max() < 0.0015
    total = session.report.total()["pad"]
    assert total.small > 0
    assert total.small % 25 == 0
    assert f"{total.small} in regions too small" in told
    _, (touching, passing), _ = read(log, replace(rig, gate=WITHOUT))
    assert len(passing.contacts) > 0 or kind == "deformation"
    assert np.abs(heights(touching.contacts)).max() > 0.02


def test_small_patches_of_contact_beside_a_large_one_are_left_out(tmp_path, monkeypatch):
    def wrinkled(hand):
        rows, columns = np.mgrid[:36, :48]
        hill = 0.015 * np.exp(-((rows - 4) ** 2 + (columns - 4) ** 2) / 12.0)
        return PLAIN_MEMBRANE(hand) - hill * (hand[0, 3] > 0.7)

    monkeypatch.setattr(sphere_log, "membrane", wrinkled)
    log = SphereLog().write(tmp_path / "log.mcap")
    sensitive = replace(RIG, contact=replace(RIG.contact, points=1000), gate=GateRig(part=0.5))
    session, (touching, _), _ = read(log, sensitive)
    assert np.abs(heights(touching.contacts)).max() < 0.0015
    assert session.report.total()["pad"].small > 0
    every = replace(sensitive, gate=WITHOUT)
    assert np.abs(heights(read(log, every)[1][0].contacts)).max() > 0.006


def cloud_rig(role):
    return Rig("lidar", "world", workspace=RIG.workspace, clouds=(CloudRig("/cloud", role),))


def cloud_log(path, points):
    """A log of one message of points (N, 3) in the world."""
    fixed = {"transforms": [transform("world", "lidar", parent_from_child=np.eye(4), stamp=BEGIN)]}
    cloud = ros2_cloud(points.astype(np.float32), BEGIN + 1)
    static = ("/tf_static", "tf2_msgs/TFMessage", fixed, BEGIN)
    write_ros2(path, [static, ("/cloud", "sensor_msgs/PointCloud2", cloud, BEGIN + 1)])
    return path


def on_sphere(count, centre):
    ways = np.random.default_rng(count).normal(size=(count, 3))
    return centre + RADIUS * ways / np.sqrt((ways**2).sum(axis=1, keepdims=True))


@pytest.mark.parametrize("role", ["surface", "contacts"])
def test_points_of_a_cloud_that_are_not_connected_are_left_out(tmp_path, role):
    crumbs = CENTRE + [0.0, 0.1, 0.0] + 0.004 * np.eye(3)
    other = on_sphere(600, CENTRE - [0.0, 0.15, 0.0])
    points = np.concatenate([on_sphere(2000, CENTRE), crumbs, other])
    log = cloud_log(tmp_path / "log.mcap", points)
    rig = cloud_rig(role)
    session, (probe,), told = read(log, rig, diameter=2 * RADIUS)
    assert len(probe.new_points.known) > 500
    assert np.abs(heights(probe.new_points.known)).max() < 1e-6
    total = session.report.total()["/cloud"]
    assert 1 <= total.small <= 3
    assert total.far > 300  # a second body of the same size
    assert f"{total.small} in regions too small, {total.far} in regions too far" in told
    kept = read(log, replace(rig, gate=GateRig(part=0.0)), diameter=2 * RADIUS)[0].report.total()[
        "/cloud"
    ]
    assert (kept.small, kept.far) == (0, total.far + total.small)
    touches = CENTRE + RADIUS * np.concatenate([np.eye(3), -np.eye(3)[:1]])  # few, all kept
    few = cloud_log(tmp_path / "few.mcap", touches)
    assert len(read(few, rig, diameter=2 * RADIUS)[1][0].new_points.known) == 4


def test_ends_of_rays_that_are_too_far_away_give_no_free_space(tmp_path):
    ends = np.array([[1.0, 0.2, 0.55], [200.0, 0.0, 100.0]])  # m
    session, (probe,), _ = read(cloud_log(tmp_path / "log.mcap", ends), cloud_rig("rays"))
    assert session.report.total()["/cloud"].outside == 1
    _, (near,), _ = read(cloud_log(tmp_path / "near.mcap", ends[:1]), cloud_rig("rays"))
    assert len(near.new_points.free) > 0
    np.testing.assert_array_equal(probe.new_points.free, near.new_points.free)
