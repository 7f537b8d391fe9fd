"""Archives of scans: cut, unpacked, checked, placed."""

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from runners.objects.scans import AssetsConfig, DownloadError, download_scan

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
Serve = Callable[[bytes], AssetsConfig]


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


def test_no_server_at_all_is_reported(tmp_path):
    with pytest.raises(DownloadError, match=r"refused.*; try again"):
        download_scan(SCAN, AssetsConfig(str(tmp_path), "http://127.0.0.1:1"))
