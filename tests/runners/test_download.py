"""Downloads against a real HTTP server: cut, resumed, refused, unpacked, checked."""

from __future__ import annotations

import dataclasses
import io
import socket
import tarfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from runners.download import DownloadError, download
from runners.fetch import fetch_scan
from runners.objects.scans import AssetsConfig
from runners.unpack import unpack

CONTENT = np.random.default_rng(0).bytes(300_000)
SCAN = "012_strawberry"  # of the set, but of no known extents


@dataclasses.dataclass
class Server:
    """What the server holds and how it misbehaves; `requests` are the headers it has seen."""

    url: str
    content: bytes = CONTENT
    etag: str = '"one"'
    last_modified: str = ""
    ranges: bool = True
    statuses: list[int] = dataclasses.field(default_factory=list)
    cuts: list[int] = dataclasses.field(default_factory=list)
    excess: int = 0  # bytes announced that never come
    location: str = ""
    wrong_range: bool = False
    chunked: bool = False
    requests: list[dict[str, str]] = dataclasses.field(default_factory=list)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        state: Server = self.server.state  # type: ignore[attr-defined]
        state.requests.append(dict(self.headers.items()))
        status = state.statuses.pop(0) if state.statuses else 200
        validators = (state.etag, state.last_modified)
        start, total = 0, len(state.content) + state.excess
        asked = self.headers.get("Range")
        if status == 200 and asked and state.ranges and self.headers["If-Range"] in validators:
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            status = 416 if start >= total else 206
        body = state.content[start:] if status in (200, 206) else b"no"
        self.send_response(status)
        if status == 206:
            first = start + 1 if state.wrong_range else start
            self.send_header("Content-Range", f"bytes {first}-{total - 1}/{total}")
        if state.etag:
            self.send_header("ETag", state.etag)
        if state.last_modified:
            self.send_header("Last-Modified", state.last_modified)
        if state.location:
            self.send_header("Location", state.location)
        if not state.chunked:
            extra = state.excess if status in (200, 206) else 0
            self.send_header("Content-Length", str(len(body) + extra))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body[: state.cuts.pop(0)] if state.cuts else body)
        self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.state = Server(f"http://127.0.0.1:{http.server_port}/file.tgz")  # type: ignore[attr-defined]
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield http.state  # type: ignore[attr-defined]
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture
def target(tmp_path) -> Path:
    return tmp_path / "new" / "folder" / "file.tgz"


def leftovers(target: Path) -> list[str]:
    return sorted(path.name for path in target.parent.iterdir())


def test_a_file_arrives_whole_and_alone(server, target):
    seen = []
    download(server.url, target, progress=lambda done, total: seen.append((done, total)))
    assert target.read_bytes() == CONTENT
    assert leftovers(target) == ["file.tgz"]
    assert seen[0] == (0, 300_000)
    assert seen[-1] == (300_000, 300_000)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert "Range" not in server.requests[0]


def test_a_cut_connection_is_continued_at_the_byte_where_it_ended(server, target):
    server.cuts = [100_000, 50_000]
    download(server.url, target, waits=(0, 0))
    assert [request.get("Range") for request in server.requests] == [
        None,
        "bytes=100000-",
        "bytes=150000-",
    ]
    assert server.requests[1]["If-Range"] == '"one"'
    assert target.read_bytes() == CONTENT
    assert leftovers(target) == ["file.tgz"]


def test_a_later_call_continues_what_an_earlier_one_left(server, target):
    server.cuts = [100_000]
    with pytest.raises(
        DownloadError, match=r"ended after 100000 of 300000 bytes; .* to go on from"
    ):
        download(server.url, target, waits=())
    assert not target.exists()
    assert (target.parent / "file.tgz.part").read_bytes() == CONTENT[:100_000]
    download(server.url, target, waits=())
    assert server.requests[1]["Range"] == "bytes=100000-"
    assert target.read_bytes() == CONTENT


def test_the_time_of_the_last_change_stands_in_for_an_etag(server, target):
    server.etag = 'W/"weak"'
    server.last_modified = "Mon, 06 Jul 2015 12:00:00 GMT"
    server.cuts = [100_000]
    download(server.url, target, waits=(0,))
    assert server.requests[1]["If-Range"] == server.last_modified
    assert target.read_bytes() == CONTENT


def test_without_either_the_download_starts_again(server, target):
    server.etag = ""
    server.cuts = [100_000]
    download(server.url, target, waits=(0,))
    assert "Range" not in server.requests[1]
    assert target.read_bytes() == CONTENT


def test_a_server_without_ranges_sends_the_file_again(server, target):
    server.ranges = False
    server.cuts = [100_000]
    download(server.url, target, waits=(0,))
    assert server.requests[1]["Range"] == "bytes=100000-"
    assert target.read_bytes() == CONTENT


def test_a_file_that_has_changed_is_not_continued(server, target):
    server.cuts = [100_000]
    with pytest.raises(DownloadError):
        download(server.url, target, waits=())
    server.etag, server.content = '"two"', CONTENT[::-1]
    download(server.url, target, waits=())
    assert target.read_bytes() == CONTENT[::-1]


def test_the_part_of_another_address_is_not_continued(server, target):
    server.cuts = [100_000]
    with pytest.raises(DownloadError):
        download(server.url, target, waits=())
    download(server.url + "?other", target, waits=())
    assert "Range" not in server.requests[1]
    assert target.read_bytes() == CONTENT


def test_a_part_longer_than_the_file_is_thrown_away(server, target):
    server.cuts = [100_000]
    with pytest.raises(DownloadError):
        download(server.url, target, waits=())
    (target.parent / "file.tgz.part").write_bytes(CONTENT + b"more")
    download(server.url, target, waits=(0,))
    assert [request.get("Range") for request in server.requests[1:]] == ["bytes=300004-", None]
    assert target.read_bytes() == CONTENT


def test_a_continuation_at_another_byte_is_thrown_away(server, target):
    server.cuts = [100_000]
    server.wrong_range = True
    download(server.url, target, waits=(0, 0))
    assert "Range" not in server.requests[2]
    assert target.read_bytes() == CONTENT


def test_a_file_shorter_than_announced_never_appears(server, target):
    server.excess = 10
    with pytest.raises(DownloadError, match="300000 of 300010 bytes"):
        download(server.url, target, waits=(0, 0))
    assert len(server.requests) == 3
    assert not target.exists()


def test_a_server_error_is_tried_again_and_then_reported(server, target):
    server.statuses = [503, 500]
    download(server.url, target, waits=(0, 0))
    assert target.read_bytes() == CONTENT
    server.statuses = [503, 503]
    with pytest.raises(DownloadError, match="answered 503"):
        download(server.url, target.with_name("other"), waits=(0,))


def test_a_file_that_does_not_exist_is_not_asked_for_twice(server, target):
    server.statuses = [404]
    with pytest.raises(DownloadError, match=r"127\.0\.0\.1.*the server answered 404"):
        download(server.url, target, waits=(0, 0))
    assert len(server.requests) == 1
    assert leftovers(target) == []


@pytest.mark.parametrize("chunked", [False, True])
def test_a_file_over_the_limit_is_refused(server, target, chunked):
    server.chunked = chunked
    with pytest.raises(DownloadError, match="accepted: up to 299999"):
        download(server.url, target, limit=299_999, waits=())
    assert leftovers(target) == []
    download(server.url, target, limit=300_000, waits=())
    assert target.read_bytes() == CONTENT


def test_a_redirection_leads_to_no_local_file(server, target, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("secret")
    server.statuses, server.location = [302], secret.as_uri()
    with pytest.raises(DownloadError, match="302"):
        download(server.url, target, waits=())
    assert leftovers(target) == []


def test_no_server_at_all_is_reported(target):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        with pytest.raises(DownloadError, match=r"no connection \(.*refused\); run the command"):
            download(f"http://127.0.0.1:{port}/x", target, waits=(0,))


@pytest.mark.parametrize(
    "url", ["ftp://host/x", "file:///etc/passwd", "http:///x", "http://host:x/", "http://a b/", "x"]
)
def test_other_addresses_are_refused(tmp_path, url):
    with pytest.raises(SettingError, match=r"url is .*; accepted: an http:// or https:// address"):
        download(url, tmp_path / "x")


def archive_bytes(*members: tarfile.TarInfo | tuple[str, bytes], mode: str = "w:gz") -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode=mode) as tar:  # type: ignore[call-overload]
        for member in members:
            if isinstance(member, tarfile.TarInfo):
                tar.addfile(member)
            else:
                info = tarfile.TarInfo(member[0])
                info.size = len(member[1])
                tar.addfile(info, io.BytesIO(member[1]))
    return stream.getvalue()


def special(name: str, kind: bytes, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


GOOD = ("good/file", b"good")


def test_an_archive_is_unpacked_with_its_folders(tmp_path):
    archive = tmp_path / "a.tgz"
    archive.write_bytes(
        archive_bytes(special("./good", tarfile.DIRTYPE), GOOD, ("x/y/z", b"1" * 9))
    )
    unpack(archive, tmp_path / "out")
    assert (tmp_path / "out/good/file").read_bytes() == b"good"
    assert (tmp_path / "out/x/y/z").read_bytes() == b"1" * 9


@pytest.mark.parametrize(
    ("member", "reason"),
    [
        (("../escaped", b"x"), "outside"),
        (("good/../../escaped", b"x"), "outside"),
        (("/tmp/escaped", b"x"), "outside"),
        (("..\\escaped", b"x"), "outside"),
        (("C:escaped", b"x"), "outside"),
        ((".", b"x"), "both a file and a folder"),
        (special("link", tarfile.SYMTYPE, "/etc/passwd"), "neither a plain file nor a folder"),
        (special("link", tarfile.LNKTYPE, "good/file"), "neither a plain file nor a folder"),
        (special("device", tarfile.CHRTYPE), "neither a plain file nor a folder"),
        (special("pipe", tarfile.FIFOTYPE), "neither a plain file nor a folder"),
        (("good/./file", b"again"), "twice"),
        (("good/file/below", b"x"), "both a file and a folder"),
    ],
)
def test_one_harmful_member_refuses_the_whole_archive(tmp_path, member, reason):
    archive = tmp_path / "a.tgz"
    archive.write_bytes(archive_bytes(GOOD, member))
    with pytest.raises(DownloadError, match=rf"archive a\.tgz cannot be unpacked: .*{reason}"):
        unpack(archive, tmp_path / "out")
    assert leftovers(archive) == ["a.tgz"]


def test_an_archive_too_large_when_unpacked_is_refused(tmp_path):
    archive = tmp_path / "a.tgz"
    archive.write_bytes(archive_bytes(GOOD, ("bomb", bytes(3_000_000))))
    assert archive.stat().st_size < 30_000
    with pytest.raises(DownloadError, match="too large when unpacked"):
        unpack(archive, tmp_path / "out", limit=2_000_000)
    assert leftovers(archive) == ["a.tgz"]


@pytest.mark.parametrize("cut", [0, 1, 40, -20, -8, -1])
def test_an_archive_cut_anywhere_is_refused(tmp_path, cut):
    archive = tmp_path / "a.tgz"
    archive.write_bytes(archive_bytes(GOOD, ("noise", CONTENT))[:cut])
    with pytest.raises(DownloadError, match="cannot be unpacked"):
        unpack(archive, tmp_path / "out")
    assert leftovers(archive) == ["a.tgz"]


@pytest.mark.parametrize("position", [0, 4000, -6])
def test_an_archive_with_a_wrong_byte_is_refused(tmp_path, position):
    damaged = bytearray(archive_bytes(GOOD, ("noise", CONTENT)))
    damaged[position] ^= 1
    (tmp_path / "a.tgz").write_bytes(damaged)
    with pytest.raises(DownloadError, match="cannot be unpacked"):
        unpack(tmp_path / "a.tgz", tmp_path / "out")


def test_a_plain_text_is_no_archive(tmp_path):
    (tmp_path / "a.tgz").write_text("<html>Not what you asked for</html>")
    with pytest.raises(DownloadError, match="Not a gzipped file"):
        unpack(tmp_path / "a.tgz", tmp_path / "out")


def scan_archive(mesh: trimesh.Trimesh, scan: str = SCAN) -> bytes:
    ply = mesh.export(file_type="ply")
    folder = f"{scan}/google_16k"
    return archive_bytes((f"{folder}/nontextured.ply", ply), (f"{folder}/kinbody.xml", b"<x/>"))


@pytest.fixture
def assets(server, tmp_path) -> AssetsConfig:
    return AssetsConfig(str(tmp_path / "assets"), server.url.removesuffix("file.tgz"))


def fetch(assets: AssetsConfig, scan: str = SCAN) -> str:
    return fetch_scan(scan, assets, lambda done, total: None)


def test_a_scan_is_placed_as_in_the_official_archive_and_nothing_else(server, assets):
    server.content = scan_archive(trimesh.creation.box((0.1, 0.2, 0.3)))
    assert fetch(assets) == "8 vertices, 100.0 x 200.0 x 300.0 mm, watertight"
    assert sorted(str(path.relative_to(assets.folder)) for path in assets.folder.rglob("*")) == [
        SCAN,
        f"{SCAN}/google_16k",
        f"{SCAN}/google_16k/kinbody.xml",
        f"{SCAN}/google_16k/nontextured.ply",
    ]


def open_box() -> bytes:
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.update_faces(np.arange(12) > 0)
    return scan_archive(mesh)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (open_box(), "is not watertight"),
        (scan_archive(trimesh.creation.box(), scan="other"), "does not exist"),
        (archive_bytes(("../escaped", b"x")), "outside of the folder"),
        (b"<html>", "Not a gzipped file"),
    ],
)
def test_what_is_not_the_scan_leaves_nothing(server, assets, content, reason):
    server.content = content
    with pytest.raises(DownloadError, match=rf"_google_16k\.tgz is not the archive .*{reason}"):
        fetch(assets)
    assert list(assets.folder.iterdir()) == []
    assert not (assets.folder.parent / "escaped").exists()


def test_a_scan_of_other_extents_is_refused(server, assets):
    drill = "035_power_drill"
    extents = np.array([0.1605, 0.1210, 0.1915])
    server.content = scan_archive(trimesh.creation.box(extents * [1, 1.011, 1]), drill)
    with pytest.raises(DownloadError, match=r"160\.5 x 122\.3 x 191\.5 mm; expected: 160\.5 x 121"):
        fetch(assets, drill)
    server.content = scan_archive(trimesh.creation.box(extents * [1, 1.009, 1]), drill)
    assert "watertight" in fetch(assets, drill)


def test_an_interrupted_scan_is_continued(server, assets, monkeypatch):
    monkeypatch.setattr("runners.fetch.download", lambda *a, **k: download(*a, waits=(), **k))
    server.content = scan_archive(trimesh.creation.icosphere(3, 0.1))
    server.cuts = [5000]
    with pytest.raises(DownloadError, match="ended after 5000"):
        fetch(assets)
    assert "642 vertices" in fetch(assets)
    assert server.requests[1]["Range"] == "bytes=5000-"


def test_an_empty_assets_folder_setting_is_refused():
    with pytest.raises(SettingError, match="dir is empty"):
        AssetsConfig("", "http://host")
    with pytest.raises(SettingError, match="url is"):
        AssetsConfig("x", "host")


def test_the_home_folder_is_expanded(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert AssetsConfig("~/scans", "http://host").folder == tmp_path / "scans"
