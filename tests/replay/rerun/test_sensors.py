"""Hand, cameras and images of a robot session in the Rerun recording."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh

from chsel.problem.poses import compose
from replay.events import Event, RigDescribed, SensorImage
from replay.rerun.scene import deepest
from replay.rerun.sensors import display_size, pixel_classes
from tests.replay.rerun.test_recorder import probe, registration, started, write
from tests.tools.rrd_rows import at_probe, read, until_probe

HAND = trimesh.creation.box((0.1, 0.08, 0.06))
POSE = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.2, 0.9]))


def depth(step: int, *, height: int = 4, width: int = 6, sensor: str = "camera") -> SensorImage:
    values = np.arange(height * width, dtype=np.uint16).reshape(height, width) * 50
    mask = values > 200
    camera = np.array([8.0, 9.0, 2.5, 1.5])
    return SensorImage(step, sensor, "depth", values, 0.001, mask, camera, POSE)


def touch(step: int, pixels: int) -> SensorImage:
    values = np.zeros((3, 5), dtype=np.uint16)
    values.flat[:pixels] = 60
    camera = np.array([8.0, 9.0, 2.5, 1.5])
    return SensorImage(step, "pad_1", "deformation", values, 0.0001, values > 40, camera, POSE)


def robot_session() -> list[Event]:
    """Three probes; the pad tells nothing of the last."""
    events: list[Event] = [started(), RigDescribed(-1, "cabinet", "0a1b", HAND)]
    for step in range(3):
        events += [depth(step), dataclasses.replace(depth(step), unit=0.002)]
        if step < 2:
            events += [touch(step, pixels) for pixels in (1, 7, 4)]
        events += [probe(step), *registration(step)]
    return events


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write(tmp_path_factory.mktemp("rerun") / "recording.rrd", robot_session())


@pytest.fixture(scope="module")
def rows(recording):
    return read(recording)


def pixels(row: dict[str, Any], kind: str, dtype: type, shape: tuple[int, int]) -> np.ndarray:
    (buffer,) = row[f"{kind}:buffer"]
    array: np.ndarray = np.array(buffer, dtype=np.uint8).view(dtype).reshape(shape)
    return array


def test_the_hand_is_drawn_where_the_probe_is_deepest(rows):
    for step in range(3):
        shown = until_probe(rows["/scene/hand"], step)[-1]
        path = probe(step).gripper_path
        expected = path[deepest(path), :3, 3].astype(np.float32)
        np.testing.assert_array_equal(
            np.array(shown["InstancePoses3D:translations"], np.float32), expected[None]
        )
    assert not np.any(at_probe(rows["/scene/hand"], 0)[0]["InstancePoses3D:mat3x3"])
    mesh = next(values for _, values in rows["/scene/hand"] if "Mesh3D:vertex_positions" in values)
    np.testing.assert_allclose(np.max(mesh["Mesh3D:vertex_positions"], axis=0), [0.05, 0.04, 0.03])


def test_the_deepest_pose_is_furthest_along_the_approach():
    turned = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # z looks along x
    ways = np.array([[0.0, 0.0, 0.0], [0.2, 0.9, 0.0], [0.3, 0.0, -0.5], [0.1, 0.0, 0.0]])
    assert deepest(compose(np.tile(turned, (4, 1, 1)), ways)) == 2


def test_a_camera_stands_at_its_pose_and_sees_what_it_measured(rows):
    camera = at_probe(rows["/scene/cameras/camera"], 1)[-1]
    np.testing.assert_allclose(camera["Transform3D:translation"], [[0.1, 0.2, 0.9]], rtol=1e-6)
    np.testing.assert_allclose(
        np.reshape(camera["Pinhole:image_from_camera"], (3, 3)).T,
        [[8.0, 0.0, 2.5], [0.0, 9.0, 1.5], [0.0, 0.0, 1.0]],
    )
    seen = at_probe(rows["/scene/cameras/camera/depth"], 1)[-1]
    np.testing.assert_array_equal(pixels(seen, "DepthImage", np.uint16, (4, 6)), depth(1).values)
    assert seen["DepthImage:meter"] == [500.0]  # of the last image, of 2 mm a unit


def test_each_image_has_its_moment_and_a_probe_shows_the_largest_contact(rows):
    drawn = [
        (
            times["iteration"],
            int((pixels(values, "SegmentationImage", np.uint8, (3, 5)) == 0).sum()),
        )
        for times, values in rows["/sensors/pad_1/pixels"]
        if times.get("probe") == 0 and "SegmentationImage:buffer" in values
    ]
    moments, counts = zip(*drawn, strict=True)
    assert counts == (1, 7, 4, 7)
    assert moments == (3, 4, 5, 5)  # after the two of the camera


def test_large_images_are_thinned_out_for_the_eye():
    large = depth(0, height=5, width=1000)
    small = display_size(large)
    assert small.values.tolist() == large.values[::4, ::4].tolist()
    assert small.mask.tolist() == large.mask[::4, ::4].tolist()
    assert small.intrinsics.tolist() == [2.0, 2.25, 0.625, 0.375]
    assert display_size(depth(0)).values.shape == (4, 6)
    assert set(np.unique(pixel_classes(depth(0)))) == {0, 1, 2}
