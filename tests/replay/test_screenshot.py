"""Pictures of recordings, and viewers that are slow, hang or end."""

from __future__ import annotations

import socket
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from chsel.errors import RecordingError
from replay import screenshot
from replay.screenshot import main, save_screenshot

# A viewer that listens at its port and answers nothing; or one that ends with a message.
_SILENT = """
import socket, sys, time
server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
time.sleep(600)
"""
_ENDING = "print('no\\x1b[31m graphics'); raise SystemExit(3)"
LOADED = SimpleNamespace(loading=[], recordings=[SimpleNamespace(timelines=["probe"])])


class Client:
    """Answers as a viewer does; pictures: what each request for one gives."""

    def __init__(self, *pictures: bytes | Exception) -> None:
        self._pictures = iter(pictures)

    def get_state(self) -> SimpleNamespace:
        return LOADED

    def take_screenshot(self) -> bytes:
        picture = next(self._pictures)
        if isinstance(picture, Exception):
            raise picture
        return picture


class HangingClient:
    """Waits for an answer as long as the viewer lives, as the real one does."""

    def __init__(self, url: str) -> None:
        self._address = ("127.0.0.1", int(url.rpartition(":")[2].partition("/")[0]))

    def get_state(self) -> None:
        with socket.create_connection(self._address) as asking:
            asking.recv(1)
        raise RuntimeError("transport error")


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    path = tmp_path / "recording.rrd"
    path.touch()
    return path


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Puts a program in the viewer's place."""

    def program(code: str, client: object) -> None:
        path = tmp_path / "viewer"
        path.write_text(f"#!{sys.executable}\n{code}")
        path.chmod(0o755)
        monkeypatch.setattr(screenshot, "viewer_program", lambda: path)
        monkeypatch.setattr(screenshot, "ViewerClient", SimpleNamespace(connect=client))
        monkeypatch.setattr(screenshot, "SETTLE_SECONDS", 0.0)

    return program


def test_a_recording_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording .*none\.rrd does not exist"):
        save_screenshot(tmp_path / "none.rrd", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("error", [TimeoutError, ConnectionError, RuntimeError])
def test_a_viewer_that_does_not_paint_in_its_time_is_asked_again(error, rrd, viewer) -> None:
    late = error("the viewer has not painted within 15 s")
    client = Client(late, late, b"first", late, b"png")
    viewer(_SILENT, lambda _: client)
    out = rrd.with_suffix(".png")
    save_screenshot(rrd, out)
    assert out.read_bytes() == b"png"


def test_a_viewer_that_never_paints_is_one_error(rrd, viewer, monkeypatch, capsys) -> None:
    monkeypatch.setattr(screenshot, "LIMIT_SECONDS", 2.0)
    client = Client(*[TimeoutError("not painted\n  within 15 s")] * 100)
    viewer(_SILENT, lambda _: client)
    assert main([str(rrd), str(rrd.with_suffix(".png"))]) == 2
    assert capsys.readouterr().err == (
        "error: the Rerun viewer gave no picture: after 2 s, not painted within 15 s\n"
    )
    assert not rrd.with_suffix(".png").exists()


def test_a_viewer_that_hangs_is_given_up(rrd, viewer, monkeypatch) -> None:
    monkeypatch.setattr(screenshot, "LIMIT_SECONDS", 2.0)
    viewer(_SILENT, HangingClient)
    begun = time.monotonic()
    with pytest.raises(RecordingError, match="gave no picture: after 2 s, "):
        save_screenshot(rrd, rrd.with_suffix(".png"))
    assert time.monotonic() - begun < 60.0


def test_a_viewer_that_ends_is_quoted(rrd, viewer, capsys) -> None:
    viewer(_ENDING, Client)
    assert main([str(rrd), str(rrd.with_suffix(".png"))]) == 2
    assert capsys.readouterr().err == (
        "error: the Rerun viewer gave no picture: it ended: no\\x1b[31m graphics\n"
    )
