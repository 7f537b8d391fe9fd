"""What sensors measured of something else, or wrongly, does not become points of the object."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from replay.events import Logged, Probe
from replay.mcap.reader import read_recording
from runners.probe import main
from runners.sensors.rig import CloudRig, GateRig, Rig
from runners.sessions.sensors import SensorsSession, SensorsSettings
from tests.runners.in_process import run
from tests.runners.sensors import sphere_log
from tests.runners.sensors.small_logs import ros2_cloud, ros2_transform, write_ros2
from tests.runners.sensors.sphere_log import BEGIN, CENTRE, MEMBRANE, RADIUS, RIG, SphereLog
from tests.runners.sensors.test_depth_frame import scene, written

PLAIN_MEMBRANE, PLAIN_SEEN = sphere_log.membrane, sphere_log.seen
WITHOUT = GateRig(jump=1e6, part=0.0, speckle=0)


def read(path: Path, rig: Rig) -> tuple[SensorsSession, list[Probe], str]:
    session = SensorsSession(SensorsSettings(rig, str(path)), 0, diameter=2 * RADIUS)
    events = list(session.probes())
    told = "\n".join(event.text for event in events if isinstance(event, Logged))
    return session, [event for event in events if isinstance(event, Probe)], told


def off_sphere(points: np.ndarray) -> np.ndarray:
    return np.abs(np.sqrt(((points - CENTRE) ** 2).sum(axis=1)) - RADIUS)


def test_pixels_of_a_pad_that_jump_are_no_contact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoilt(hand: np.ndarray) -> np.ndarray:
        depth = PLAIN_MEMBRANE(hand)
        depth[2:7, 40:45] = 0.02  # a reflection, 40 mm before the membrane at all times
        return depth if hand[0, 3] > 0.7 else PLAIN_MEMBRANE(hand)

    monkeypatch.setattr(sphere_log, "membrane", spoilt)
    log = SphereLog().write(tmp_path / "log.mcap")
    session, (touching, passing), told = read(log, RIG)
    assert len(touching.contacts) == 50
    assert off_sphere(touching.contacts).max() < 0.0015
    assert len(passing.contacts) == 0
    total = session.report.total()["pad"]
    assert total.small > 0
    assert total.small % 25 == 0
    assert f"pad: left out of {total.pixels} pixels or points: {total.small} in regions" in told
    spoiling = read(log, replace(RIG, gate=WITHOUT))[1]
    assert off_sphere(spoiling[0].contacts).max() > 0.02
    assert len(spoiling[1].contacts) > 0


def test_deformations_of_pixels_that_are_left_out_do_not_spread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sent(hand: np.ndarray) -> np.ndarray:
        pressed = MEMBRANE - PLAIN_MEMBRANE(hand)
        pressed[2:7, 40:45] = 0.04  # a reflection, far before its neighbours
        return pressed

    monkeypatch.setattr(sphere_log, "membrane", sent)
    log = SphereLog().write(tmp_path / "log.mcap")
    np.save(tmp_path / "untouched.npy", np.full((36, 48), MEMBRANE))
    reference = str(tmp_path / "untouched.npy")
    pad = replace(RIG.bubbles[0], kind="deformation", reference=reference)
    _, (touching, passing), _ = read(log, replace(RIG, bubbles=(pad,)))
    assert len(touching.contacts) == 50
    assert off_sphere(touching.contacts).max() < 0.0015
    assert len(passing.contacts) == 0  # the mean filter has nothing to spread around the reflection


def test_small_patches_of_contact_beside_a_large_one_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrinkled(hand: np.ndarray) -> np.ndarray:
        depth = PLAIN_MEMBRANE(hand)
        rows, columns = np.mgrid[:36, :48]
        hill = 0.015 * np.exp(-((rows - 4) ** 2 + (columns - 4) ** 2) / 12.0)
        return depth - hill * (hand[0, 3] > 0.7)

    monkeypatch.setattr(sphere_log, "membrane", wrinkled)
    log = SphereLog().write(tmp_path / "log.mcap")
    sensitive = replace(RIG, contact=replace(RIG.contact, points=1000), gate=GateRig(part=0.5))
    session, (touching, _), _ = read(log, sensitive)
    assert off_sphere(touching.contacts).max() < 0.0015
    assert session.report.total()["pad"].small > 0
    every = replace(sensitive, gate=WITHOUT)
    assert off_sphere(read(log, every)[1][0].contacts).max() > 0.006


def test_few_pixels_behind_the_object_give_no_rays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoilt() -> np.ndarray:
        depth = PLAIN_SEEN()
        rows, columns = np.nonzero(depth == depth.min())
        row, column = int(rows[0]), int(columns[0])  # of the sphere, whose half this is
        depth[row - 2 : row + 3, column - 2 : column + 3] += 0.045
        return depth

    monkeypatch.setattr(sphere_log, "seen", spoilt)
    log = SphereLog().write(tmp_path / "log.mcap")
    rays = replace(RIG.cameras[0], edge=0.2)
    session, found, _ = read(log, replace(RIG, cameras=(rays,), hand=None, bubbles=()))
    free = np.concatenate([probe.new_points.free for probe in found])
    count = session.report.total()["camera"]
    assert count.small >= 25 * count.used
    assert np.sqrt(((free - CENTRE) ** 2).sum(axis=1)).min() > RADIUS - 0.01
    plain = replace(RIG, cameras=(rays,), hand=None, bubbles=(), gate=WITHOUT)
    free = np.concatenate([probe.new_points.free for probe in read(log, plain)[1]])
    assert np.sqrt(((free - CENTRE) ** 2).sum(axis=1)).min() < RADIUS - 0.02


def cloud_log(path: Path, points: np.ndarray) -> Path:
    """A log of one message of points (N, 3) in the world."""
    fixed = {"transforms": [ros2_transform("world", "lidar", (0.0, 0.0, 0.0), BEGIN)]}
    cloud = ros2_cloud(points.astype(np.float32), BEGIN + 1)
    write_ros2(
        path,
        [
            ("/tf_static", "tf2_msgs/TFMessage", fixed, BEGIN),
            ("/cloud", "sensor_msgs/PointCloud2", cloud, BEGIN + 1),
        ],
    )
    return path


def on_sphere(count: int, centre: np.ndarray) -> np.ndarray:
    ways = np.random.default_rng(count).normal(size=(count, 3))
    return centre + RADIUS * ways / np.sqrt((ways**2).sum(axis=1, keepdims=True))


@pytest.mark.parametrize("role", ["surface", "contacts"])
def test_points_of_a_cloud_that_are_not_connected_are_left_out(tmp_path: Path, role: str) -> None:
    main = on_sphere(2000, CENTRE)
    crumbs = CENTRE + [0.0, 0.1, 0.0] + 0.004 * np.eye(3)
    other = on_sphere(600, CENTRE - [0.0, 0.15, 0.0])
    log = cloud_log(tmp_path / "log.mcap", np.concatenate([main, crumbs, other]))
    rig = Rig("lidar", "world", RIG.workspace, clouds=(CloudRig("/cloud", role),))
    session, (probe,), told = read(log, rig)
    assert len(probe.new_points.known) > 500
    assert off_sphere(probe.new_points.known).max() < 1e-6
    total = session.report.total()["/cloud"]
    assert 1 <= total.small <= 3
    assert total.far > 300  # a second body of the same size
    assert f"{total.small} in regions too small, {total.far} in regions too far" in told
    kept = read(log, replace(rig, gate=GateRig(part=0.0)))[0].report.total()["/cloud"]
    assert (kept.small, kept.far) == (0, total.far + total.small)


def test_a_few_touches_are_all_kept(tmp_path: Path) -> None:
    touches = CENTRE + RADIUS * np.concatenate([np.eye(3), -np.eye(3)[:1]])
    log = cloud_log(tmp_path / "log.mcap", touches)
    rig = Rig("lidar", "world", RIG.workspace, clouds=(CloudRig("/cloud", "contacts"),))
    assert len(read(log, rig)[1][0].contacts) == 4


def test_ends_of_rays_that_are_too_far_away_give_no_free_space(tmp_path: Path) -> None:
    ends = np.array([[1.0, 0.2, 0.55], [200.0, 0.0, 100.0]])  # m
    log = cloud_log(tmp_path / "log.mcap", ends)
    rig = Rig("lidar", "world", RIG.workspace, clouds=(CloudRig("/cloud", "rays"),))
    session, (probe,), _ = read(log, rig)
    assert session.report.total()["/cloud"].outside == 1
    log = cloud_log(tmp_path / "near.mcap", ends[:1])
    (near,) = read(log, rig)[1]
    assert len(near.new_points.free) > 0
    np.testing.assert_array_equal(probe.new_points.free, near.new_points.free)


def test_counts_stand_in_the_table_the_recording_and_the_summary(tmp_path: Path) -> None:
    path = written(tmp_path)
    depth = scene()[0]
    depth[22:38, 30:45] = 520 + 40 * (np.indices((16, 15)).sum(axis=0) % 2)  # of no surface
    Image.fromarray(depth).save(tmp_path / "depth.png")
    trimesh.creation.box((0.15, 0.1, 0.05)).export(tmp_path / "box.ply")
    done = run(
        main,
        "session=sensors",
        f"session.path={path}",
        "session/rig=depth_frame",
        "session.rig.cameras.0.edge=null",
        "session.object_resolution=0.02",
        "object=mesh",
        f"object.path={tmp_path / 'box.ply'}",
        "method=icp",
        "recording=mcap",
        f"logs={tmp_path / 'logs'}",
    )
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "logs" / "probe").iterdir()
    counts = json.loads((folder / "summary.json").read_text())["sensors"]["camera"]
    assert (counts["images"], counts["far"], counts["outline"]) == (1, 0, 600 - 16 * 26)
    assert counts["small"] == 16 * 13 - 8  # but for those beside the front that are near it
    recorded = read_recording(folder / "recording.mcap").events(images=False)
    told = [event.text for event in recorded if isinstance(event, Logged)]
    label = next(text for text in told if text.startswith("label: "))
    assert label.endswith("184 at the label's outline, 200 in regions too small")
    assert any("33 % of the label's pixels are left out" in text for text in told)
