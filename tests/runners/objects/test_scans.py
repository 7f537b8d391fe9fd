"""Scans from a real HTTP server: refused, cut, unpacked, checked."""

from __future__ import annotations

import io
import tarfile
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from runners.objects.scans import AssetsConfig, DownloadError, download_scan

SCAN = "012_strawberry"
Serve = Callable[[bytes], AssetsConfig]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Serve]:
    """Serves some bytes as the archive of any scan; nothing is answered by 404."""
    content = b""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if content else 404)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    def hold(held: bytes) -> AssetsConfig:
        nonlocal content
        content = held
        return AssetsConfig(str(tmp_path / "assets"), f"http://127.0.0.1:{http.server_port}")

    monkeypatch.setenv("no_proxy", "127.0.0.1")
    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield hold
    http.shutdown()
    thread.join()
    http.server_close()


def archive(mesh: trimesh.Trimesh, scan: str = SCAN) -> bytes:
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


def open_box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.update_faces(np.arange(12) > 0)
    return mesh


BOX = archive(trimesh.creation.box((0.1, 0.2, 0.3)))


def test_the_mesh_is_placed_as_in_the_official_archive_and_nothing_else(serve: Serve) -> None:
    assets = serve(BOX)
    assert download_scan(SCAN, assets) == "8 vertices, 100.0 x 200.0 x 300.0 mm"
    files = [path for path in assets.folder.parent.rglob("*") if path.is_file()]
    assert files == [assets.folder / SCAN / "google_16k" / "nontextured.ply"]


@pytest.mark.filterwarnings("ignore:mesh file")  # the open one
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (archive(open_box()), "not the archive of the scan: its mesh is not watertight"),
        (archive(trimesh.creation.box(), scan="other"), "not the archive .* does not exist"),
        (b"<html>", "not the archive of the scan: not a gzip file"),
        (BOX[:-200], "not the archive of the scan: Compressed file ended"),
        (b"", r"cannot be downloaded \(404 .*try again$"),
    ],
    ids=["open", "another", "a page", "cut", "nothing"],
)
def test_what_is_not_the_scan_leaves_nothing(serve: Serve, content: bytes, reason: str) -> None:
    assets = serve(content)
    with pytest.raises(DownloadError, match=rf"_google_16k\.tgz .*{reason}") as caught:
        download_scan(SCAN, assets)
    assert "\n" not in str(caught.value)
    assert list(assets.folder.iterdir()) == []


def test_no_server_at_all_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"refused.*; try again"):
        download_scan(SCAN, AssetsConfig(str(tmp_path), "http://127.0.0.1:1"))
