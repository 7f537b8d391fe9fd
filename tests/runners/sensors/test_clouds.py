"""Normals of clouds: those that were sent, and those of neighbours."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.problem.poses import roll_pitch_yaw
from runners.sensors.clouds import neighbour_normals
from runners.sensors.rig import CloudRig
from tests.runners.sensors.small_logs import read
from tests.runners.sensors.sphere_log import CENTRE, LIDAR, RADIUS, RIG, SphereLog

SKIN = replace(RIG, cameras=(), bubbles=(), clouds=(CloudRig("/skin", "contacts", normals=5),))
TURN = roll_pitch_yaw(np.array([0.4, -0.7, 1.1]))


def plane(count=400, side=0.1):
    """Points (N, 3) of a square in a plane with normal TURN[:, 2], and a little noise."""
    stream = np.random.default_rng(2)
    flat = stream.uniform(-0.5, 0.5, size=(count, 3)) * [side, side, 0.0]
    flat[:, 2] = 0.0001 * stream.normal(size=count)
    return flat @ TURN.T


def test_normals_of_a_plane_face_the_origin_of_the_sensor():
    points, every = plane(), np.arange(400)
    for side in (1.0, -1.0):
        towards = 0.3 * side * TURN[:, 2]
        normals = neighbour_normals(points, every, reach=0.02, towards=towards)
        cosine = normals @ TURN[:, 2] * side
        assert np.degrees(np.arccos(cosine.min())) < 4.0
        np.testing.assert_allclose((normals**2).sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("degrees", "known"), [(70.0, 400), (82.0, 0)])
def test_a_plane_that_is_seen_from_beside_it_has_no_normal(degrees, known):
    points, angle = plane(side=0.02), np.radians(degrees)
    towards = 5.0 * (np.cos(angle) * TURN[:, 2] + np.sin(angle) * TURN[:, 0])
    normals = neighbour_normals(points, np.arange(400), reach=0.02, towards=towards)
    assert np.count_nonzero(normals @ TURN[:, 2] > 0.99) == known
    assert np.count_nonzero(normals.any(axis=1)) == known


def test_points_without_a_plane_have_no_normal():
    points = plane()
    towards = np.array([0.0, 0.0, 1.0])
    line = np.linspace(0.0, 0.1, 60)[:, None] * TURN[:, 0]
    ball = 0.01 * np.random.default_rng(4).normal(size=(300, 3))
    for unknown in (line, ball, points[:4]):
        normals = neighbour_normals(unknown, np.arange(3), reach=0.02, towards=towards)
        np.testing.assert_array_equal(normals, np.zeros((3, 3)))
    none = neighbour_normals(points[:0], np.arange(0), reach=0.02, towards=towards)
    assert none.shape == (0, 3)


def sent(tmp_path, normals):
    """The first probe and the log's lines of a session whose skin sends points with normals."""
    ways = np.array(
        [[-1.0, 0.0, 0.0], [0.0, 0.8, 0.6], [0.0, -0.6, 0.8], [-0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]
    )
    cloud = tuple(map(tuple, (CENTRE + RADIUS * ways - LIDAR).tolist()))
    log = SphereLog(cloud=cloud, normals=normals(ways)).write(tmp_path / "log.mcap")
    _, (probe, _), told = read(log, SKIN)
    at = {
        tuple(np.rint(100 * (point - CENTRE) / RADIUS).tolist()): n
        for n, point in enumerate(probe.contacts)
    }
    order = [at[tuple(np.rint(100 * way).tolist())] for way in ways]
    return ways, probe.new_points.with_known(order), told


def test_normals_that_were_sent_are_taken(tmp_path):
    def broken(ways):
        return np.concatenate(
            [1.005 * ways[:1], ways[1:2], [[np.nan, 0.0, 1.0], [0.0, 0.0, 0.0]], 2.0 * ways[4:]]
        )

    ways, points, told = sent(tmp_path, broken)
    np.testing.assert_allclose(points.normals[:2], ways[:2], atol=1e-12)
    np.testing.assert_array_equal(points.normals[2:], np.zeros((3, 3)))
    np.testing.assert_allclose(points.normal_noise, [np.pi / 36] * 2 + [0.0] * 3)
    assert "/skin: a normal left out, as its length is not 1" in told
    assert "point away" not in told


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_normals_into_the_object_are_told(tmp_path, sign):
    ways, points, told = sent(tmp_path, lambda ways: sign * ways)
    np.testing.assert_allclose(points.normals, sign * ways, atol=1e-12)
    assert ("normals point away from the origin of its frame; accepted: normals ou" in told) == (
        sign < 0
    )


def test_a_normal_stays_with_its_point(tmp_path):
    """Of 3000 points some are not finite or out of the workspace, and one a voxel is kept."""
    ways = np.random.default_rng(5).normal(size=(3000, 3))
    ways /= np.sqrt((ways**2).sum(axis=1, keepdims=True))
    cloud = CENTRE + RADIUS * ways - LIDAR
    cloud[::7] = np.nan
    cloud[::11, 0] = 9.0
    log = SphereLog(cloud=tuple(map(tuple, cloud.tolist())), normals=ways)
    _, (probe, _), _ = read(log.write(tmp_path / "log.mcap"), SKIN)
    points = probe.new_points
    assert 300 < len(points.known) < 2000
    np.testing.assert_allclose(points.normals, (points.known - CENTRE) / RADIUS, atol=1e-9)
