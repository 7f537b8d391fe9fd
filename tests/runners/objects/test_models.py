"""Our models against the table of the scans, and against the scans where they are at hand."""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import pytest
import trimesh

from runners.objects.loader import MODELS, load_model


class Scan(NamedTuple):
    folder: str
    extents: tuple[float, float, float]  # mm
    volume: float  # cm^3


SCANS = {
    "drill": Scan("035_power_drill", (160.5, 121.0, 191.5), 641),
    "mustard": Scan("006_mustard_bottle", (82.9, 94.0, 187.5), 719),
    "hammer": Scan("048_hammer", (106.4, 332.6, 44.7), 399),
    "cracker_box": Scan("003_cracker_box", (90.0, 167.8, 238.4), 2360),
    "spam_can": Scan("010_potted_meat_can", (96.7, 88.4, 85.2), 390),
    "clamp": Scan("050_medium_clamp", (43.5, 62.5, 83.5), 99.2),
}


def _distances(source, target):
    points, _ = trimesh.sample.sample_surface(source, 5000, seed=0)
    vertices = np.array(target.vertices, dtype=np.float64)
    squared, *_ = igl.point_mesh_squared_distance(
        np.array(points), vertices, np.array(target.faces, dtype=np.int64)
    )
    return np.sqrt(squared)


def _is_inside(mesh, points):
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)
    winding = igl.winding_number(vertices, faces, np.array(points) * 1e-3)
    return (winding > 0.5).tolist()


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_one_closed_body_of_the_scans_size(name):
    model = load_model(name)
    assert model.is_watertight
    assert model.is_volume
    assert model.body_count == 1
    assert model.euler_number == 2
    assert 200 < len(model.faces) < 5000
    np.testing.assert_allclose(model.extents * 1e3, SCANS[name].extents, rtol=0.03)
    assert model.volume * 1e6 == pytest.approx(SCANS[name].volume, rel=0.03)


def test_the_drill_has_a_body_a_chuck_a_handle_and_a_foot_with_space_between_them():
    drill = load_model("drill")
    chuck, body, handle, foot = [72, 65, 161], [-40, -5, 155], [-18, 3, 75], [35, 35, 15]
    assert _is_inside(drill, [chuck, body, handle, foot]) == [True] * 4
    before_handle, behind_handle, below_chuck = [10, 20, 75], [-50, -20, 75], [60, 58, 125]
    assert _is_inside(drill, [before_handle, behind_handle, below_chuck]) == [False] * 3


@pytest.mark.parametrize("name", MODELS)
def test_a_model_lies_close_to_its_scan(name, ycb_directory):
    scan = trimesh.load_mesh(ycb_directory / SCANS[name].folder / "google_16k/nontextured.ply")
    model = load_model(name)
    np.testing.assert_allclose(model.extents, scan.extents, rtol=0.03)
    assert model.volume == pytest.approx(scan.volume, rel=0.03)
    mean_distance = (_distances(model, scan).mean() + _distances(scan, model).mean()) / 2
    assert mean_distance < 1e-3
