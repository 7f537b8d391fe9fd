"""Models of the objects beside their scans, and the download of a scan."""

import io
import tarfile
from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np
import pytest
import trimesh

from runners.objects.loader import MODELS, load_model
from runners.objects.scans import AssetsConfig, DownloadError, download_scan


class Scan(NamedTuple):
    folder: str
    extents: tuple[float, float, float]  # mm
    volume: float  # cm^3


SCANS = {
    "drill": Scan("035_power_drill", (160.5, 121.0, 191.5), volume=641),
    "mustard": Scan("006_mustard_bottle", (82.9, 94.0, 187.5), volume=719),
    "hammer": Scan("048_hammer", (106.4, 332.6, 44.7), volume=399),
    "cracker_box": Scan("003_cracker_box", (90.0, 167.8, 238.4), volume=2360),
    "spam_can": Scan("010_potted_meat_can", (96.7, 88.4, 85.2), volume=390),
    "clamp": Scan("050_medium_clamp", (43.5, 62.5, 83.5), volume=99.2),
}


def _distances(source, target):
    points, _ = trimesh.sample.sample_surface(source, 5000, seed=0)
    vertices = np.array(target.vertices, dtype=np.float64)
    squared, *_ = igl.point_mesh_squared_distance(
        np.array(points), vertices, np.array(target.faces, dtype=np.int64)
    )
    return np.sqrt(squared)


def _is_inside(mesh, points):
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces, dtype=np.int64)
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
    chuck = [72, 65, 161]
    body = [-40, -5, 155]
    handle = [-18, 3, 75]
    foot = [35, 35, 15]
    assert _is_inside(drill, [chuck, body, handle, foot]) == [True] * 4
    before_handle = [10, 20, 75]
    behind_handle = [-50, -20, 75]
    below_chuck = [60, 58, 125]
    assert _is_inside(drill, [before_handle, behind_handle, below_chuck]) == [False] * 3


@pytest.mark.parametrize("name", MODELS)
def test_a_model_lies_close_to_its_scan(name, ycb_directory):
    scan = trimesh.load_mesh(ycb_directory / SCANS[name].folder / "google_16k/nontextured.ply")
    model = load_model(name)
    np.testing.assert_allclose(model.extents, scan.extents, rtol=0.03)
    assert model.volume == pytest.approx(scan.volume, rel=0.03)
    mean_distance = (_distances(model, scan).mean() + _distances(scan, model).mean()) / 2
    assert mean_distance < 1e-3


SCAN = "012_strawberry"


def archive(mesh, scan=SCAN):
    ply = mesh.export(file_type="ply")
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as tar:
        for name, content in (
            (f"{scan}/google_16k/kinbody.xml", b"<x/>"),
            (f"./{scan}/google_16k/nontextured.ply", ply),
            ("../escaped", b"x"),
        ):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return stream.getvalue()


def open_box():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.update_faces(np.arange(12) > 0)
    return mesh


BOX = archive(trimesh.creation.box((0.1, 0.2, 0.3)))


@pytest.fixture
def serve(monkeypatch, tmp_path):
    """Hands some bytes out as the archive of any scan."""

    def hold(content):
        def retrieve(url, known_hash, path, downloader):
            (Path(path) / "archive").write_bytes(content)
            return str(Path(path) / "archive")

        monkeypatch.setattr("pooch.retrieve", retrieve)
        return AssetsConfig(str(tmp_path / "assets"), "http://host")

    return hold


def test_the_mesh_is_placed_as_in_the_official_archive_and_nothing_else(serve):
    assets = serve(BOX)
    assert download_scan(SCAN, assets) == "8 vertices, 100.0 x 200.0 x 300.0 mm"
    files = [path for path in assets.folder.parent.rglob("*") if path.is_file()]
    assert files == [assets.folder / SCAN / "google_16k" / "nontextured.ply"]


@pytest.mark.filterwarnings("ignore:mesh file")  # the open one
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (archive(open_box()), "its mesh is not watertight"),
        (archive(trimesh.creation.box(), scan="other"), "does not exist"),
        (b"<html>", "not a gzip file"),
        (BOX[:-200], "Compressed file ended"),
    ],
    ids=["open", "another", "a page", "cut"],
)
def test_what_is_not_the_scan_leaves_nothing(serve, content, reason):
    assets = serve(content)
    with pytest.raises(DownloadError, match=rf"_google_16k\.tgz is not the archive .*{reason}"):
        download_scan(SCAN, assets)
    assert list(assets.folder.iterdir()) == []
