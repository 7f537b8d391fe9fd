"""The benchmark of depth images."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.sensing.depth_camera import PinholeCamera
from runners.benchmarks.depth_images import CAMERA, POSE, depth_images, scene
from runners.benchmarks.registrations import Scope, Steps


def test_the_scene_is_a_ball_on_the_floor_in_front_of_a_wall() -> None:
    points = CAMERA.back_project(scene()) @ POSE[:3, :3].T + POSE[:3, 3]
    on_floor = np.abs(points[..., 2] - 0.31) < 1e-9
    on_wall = np.abs(points[..., 0] - 1.1) < 1e-9
    away = np.sqrt(((points - [0.9, 0.0, 0.39]) ** 2).sum(axis=-1))
    on_ball = np.abs(away - 0.08) < 1e-9
    assert (on_floor | on_wall | on_ball).all()
    assert min(on_floor.mean(), on_wall.mean(), on_ball.mean()) > 0.05


def test_one_image_is_measured_each_way_and_traversal_finds_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
    monkeypatch.setattr("runners.benchmarks.depth_images.CAMERA", small)
    rows = list(depth_images(Scope(Steps(), 2, 0, (), ())))
    taken = [row for row in rows if row.unit == "ms"]
    assert len(taken) == 5
    assert all(len(row.samples) == 2 and min(row.samples) > 0.0 for row in taken)
    free = {row.case: row.median for row in rows if row.unit == "voxels"}
    assert free["scaled"] == pytest.approx(free["numpy"], rel=1e-3)
    assert free["traversal"] > 1.3 * free["scaled"]
