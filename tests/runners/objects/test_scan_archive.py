"""Scans from a real HTTP server: cut, refused, too large, unpacked, checked."""

from __future__ import annotations

import io
import socket
import tarfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from runners.fetch import fetch_scan
from runners.objects.scan_archive import CHUNK, DownloadError, download, unpack
from runners.objects.scans import AssetsConfig

CONTENT = np.random.default_rng(0).bytes(300_000)
SCAN = "012_strawberry"  # of the set, but of no known extents


@dataclass
class Server:
    """What the server holds, and how it misbehaves; requests: how many it has seen."""

    url: str
    content: bytes = CONTENT
    statuses: list[int] = field(default_factory=list)
    cuts: list[int] = field(default_factory=list)
    location: str = ""
    chunked: bool = False
    requests: int = 0


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        state: Server = self.server.state  # type: ignore[attr-defined]
        state.requests += 1
        status = state.statuses.pop(0) if state.statuses else 200
        body = state.content if status == 200 else b"no"
        self.send_response(status)
        if state.location:
            self.send_header("Location", state.location)
        if not state.chunked:
            self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body[: state.cuts.pop(0)] if state.cuts else body)
        self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr("time.sleep", lambda seconds: None)  # of pooch, between attempts
    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.state = Server(f"http://127.0.0.1:{http.server_port}/file.tgz")  # type: ignore[attr-defined]
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield http.state  # type: ignore[attr-defined]
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "new" / "folder" / "file.tgz"


def names_beside(target: Path) -> list[str]:
    return sorted(path.name for path in target.parent.iterdir())


def test_a_file_arrives_whole_and_alone(server: Server, target: Path) -> None:
    seen: list[tuple[int, int | None]] = []
    download(server.url, target, progress=lambda done, total: seen.append((done, total)))
    assert target.read_bytes() == CONTENT
    assert names_beside(target) == ["file.tgz"]
    assert (seen[0], seen[-1]) == ((0, 300_000), (300_000, 300_000))
    assert [done for done, _ in seen[:-1]] == sorted(done for done, _ in seen[:-1])


@pytest.mark.parametrize("failures", [{"cuts": [100_000, 0]}, {"statuses": [503, 429]}], ids=str)
def test_a_failed_connection_is_tried_again_and_then_reported(
    failures: dict[str, list[int]], server: Server, target: Path
) -> None:
    vars(server).update({name: list(values) for name, values in failures.items()})
    download(server.url, target, retries=2)
    assert (target.read_bytes(), server.requests) == (CONTENT, 3)
    vars(server).update({name: list(values) for name, values in failures.items()})
    with pytest.raises(DownloadError, match=r"; run the command again to retry") as caught:
        download(server.url, target.with_name("other"), retries=1)
    assert "\n" not in str(caught.value)
    assert names_beside(target) == ["file.tgz"]


def test_a_file_that_does_not_exist_is_not_asked_for_twice(server: Server, target: Path) -> None:
    server.statuses = [404]
    with pytest.raises(DownloadError, match=r"127\.0\.0\.1.*the server answered 404"):
        download(server.url, target)
    assert server.requests == 1
    assert names_beside(target) == []


@pytest.mark.parametrize("chunked", [False, True])
def test_a_file_over_the_limit_is_refused(server: Server, target: Path, chunked: bool) -> None:
    server.chunked = chunked
    limit = len(CONTENT) - CHUNK - 1
    with pytest.raises(DownloadError, match=f"too large; accepted: up to {limit} bytes"):
        download(server.url, target, limit=limit)
    assert server.requests == 1
    assert names_beside(target) == []
    download(server.url, target, limit=300_000)
    assert target.read_bytes() == CONTENT


def test_a_redirection_leads_to_no_local_file(server: Server, target: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    server.statuses, server.location = [302], (tmp_path / "secret").as_uri()
    with pytest.raises(DownloadError, match="secret"):
        download(server.url, target, retries=0)
    assert names_beside(target) == []


def test_no_server_at_all_is_reported(server: Server, target: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        with pytest.raises(DownloadError, match=r"refused.*; run the command again"):
            download(f"http://127.0.0.1:{unused.getsockname()[1]}/x", target, retries=0)


@pytest.mark.parametrize(
    "url", ["ftp://host/x", "file:///etc/passwd", "http:///x", "http://host:x/", "http://a b/", "x"]
)
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(SettingError, match=r"url is .*; accepted: an http:// or https:// address"):
        AssetsConfig("assets", url)


Member = tarfile.TarInfo | tuple[str, bytes]


def archive_bytes(*members: Member) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as tar:
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


def test_an_archive_is_unpacked_with_its_folders(tmp_path: Path) -> None:
    archive = tmp_path / "a.tgz"
    folder = special("./good", tarfile.DIRTYPE)
    archive.write_bytes(archive_bytes(folder, GOOD, ("x/y/z", b"1" * 9)))
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
        ((".", b"x"), "the place of another"),
        (special("link", tarfile.SYMTYPE, "/etc/passwd"), "neither a plain file nor a folder"),
        (special("link", tarfile.LNKTYPE, "good/file"), "neither a plain file nor a folder"),
        (special("device", tarfile.CHRTYPE), "neither a plain file nor a folder"),
        (special("pipe", tarfile.FIFOTYPE), "neither a plain file nor a folder"),
        (("good/./file", b"again"), "the place of another"),
        (("good/file/below", b"x"), "the place of another"),
        (special("good/file", tarfile.DIRTYPE), "the place of another"),
    ],
)
def test_a_harmful_member_is_refused(tmp_path: Path, member: Member, reason: str) -> None:
    archive = tmp_path / "a.tgz"
    archive.write_bytes(archive_bytes(GOOD, member, ("later", b"x")))
    with pytest.raises(DownloadError, match=rf"archive a\.tgz cannot be unpacked: .*{reason}"):
        unpack(archive, tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == {"a.tgz", "out"}
    assert {path.name for path in (tmp_path / "out").rglob("*")} == {"good", "file"}
    assert (tmp_path / "out/good/file").read_bytes() == b"good"


def test_an_archive_too_large_when_unpacked_is_refused(tmp_path: Path) -> None:
    archive = tmp_path / "a.tgz"
    archive.write_bytes(archive_bytes(GOOD, ("bomb", bytes(3_000_000))))
    assert archive.stat().st_size < 30_000
    with pytest.raises(DownloadError, match="too large when unpacked"):
        unpack(archive, tmp_path / "out", limit=2_000_000)
    written = [path.stat().st_size for path in tmp_path.rglob("out/*") if path.is_file()]
    assert sum(written) <= 2_000_000


def flipped(position: int) -> Callable[[bytes], bytes]:
    def damage(content: bytes) -> bytes:
        damaged = bytearray(content)
        damaged[position] ^= 1
        return bytes(damaged)

    return damage


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    **{f"cut at {at}": lambda content, at=at: content[:at] for at in (0, 1, 40, -20, -8, -1)},
    **{f"byte {position}": flipped(position) for position in (0, 4000, -6)},
    "a page": lambda content: b"<html>Not what you asked for</html>",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_archive_is_refused(tmp_path: Path, damage: str) -> None:
    content = archive_bytes(GOOD, ("noise", CONTENT))
    (tmp_path / "a.tgz").write_bytes(DAMAGES[damage](content))
    with pytest.raises(DownloadError, match="cannot be unpacked"):
        unpack(tmp_path / "a.tgz", tmp_path / "out")


def scan_archive(mesh: trimesh.Trimesh, scan: str = SCAN) -> bytes:
    ply = mesh.export(file_type="ply")
    folder = f"{scan}/google_16k"
    return archive_bytes((f"{folder}/nontextured.ply", ply), (f"{folder}/kinbody.xml", b"<x/>"))


@pytest.fixture
def assets(server: Server, tmp_path: Path) -> AssetsConfig:
    return AssetsConfig(str(tmp_path / "assets"), server.url.removesuffix("file.tgz"))


def fetch(assets: AssetsConfig, scan: str = SCAN) -> str:
    return fetch_scan(scan, assets, lambda done, total: None)


def test_a_scan_is_placed_as_in_the_official_archive_and_nothing_else(
    server: Server, assets: AssetsConfig
) -> None:
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
def test_what_is_not_the_scan_leaves_nothing(
    server: Server, assets: AssetsConfig, content: bytes, reason: str
) -> None:
    server.content = content
    with pytest.raises(DownloadError, match=rf"_google_16k\.tgz is not the archive .*{reason}"):
        fetch(assets)
    assert list(assets.folder.iterdir()) == []
    assert not (assets.folder.parent / "escaped").exists()


def test_a_scan_of_other_extents_is_refused(server: Server, assets: AssetsConfig) -> None:
    drill = "035_power_drill"
    extents = np.array([0.1605, 0.1210, 0.1915])
    server.content = scan_archive(trimesh.creation.box(extents * [1, 1.011, 1]), drill)
    with pytest.raises(DownloadError, match=r"160\.5 x 122\.3 x 191\.5 mm; expected: 160\.5 x 121"):
        fetch(assets, drill)
    server.content = scan_archive(trimesh.creation.box(extents * [1, 1.009, 1]), drill)
    assert "watertight" in fetch(assets, drill)


def test_a_folder_of_scans_is_given_and_its_home_is_expanded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match="dir is empty"):
        AssetsConfig("", "http://host")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert AssetsConfig("~/scans", "http://host").folder == tmp_path / "scans"
