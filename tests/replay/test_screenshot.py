"""Pictures of recordings."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from chsel.errors import RecordingError
from replay import screenshot
from replay.rerun import viewer as rerun_viewer
from replay.screenshot import headless_viewer, main, save_screenshot

# A viewer that listens at its port and answers nothing; or one that ends with a message.
_SILENT = """
import socket, sys, time
server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
time.sleep(600)
"""
_ENDING = "print('no\\x1b[31m graphics'); raise SystemExit(3)"
_VIEWS = [SimpleNamespace(name="Scene", view_id="3"), SimpleNamespace(name="Log", view_id="4")]
_LOADED = SimpleNamespace(
    loading=[], recordings=[SimpleNamespace(timelines=["probe"])], views=_VIEWS
)


class Client:
    """Answers as a viewer does; pictures: what requests for one give, the last one ever after."""

    def __init__(self, *pictures: bytes | Exception) -> None:
        self._pictures = [*pictures]
        self.asked: list[str | None] = []
        self.times: list[dict[str, Any]] = []

    def get_state(self) -> SimpleNamespace:
        return _LOADED

    def take_screenshot(self, view_id: str | None = None) -> bytes:
        self.asked.append(view_id)
        picture = self._pictures.pop(0) if len(self._pictures) > 1 else self._pictures[0]
        if isinstance(picture, Exception):
            raise picture
        return picture

    def set_time(self, timeline: str, **given: Any) -> None:
        self.times.append({"timeline": timeline, **given})


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


Viewer = Callable[[str, Callable[[str], object]], None]


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Viewer:
    """Puts a program in the viewer's place."""

    def program(code: str, client: Callable[[str], object]) -> None:
        path = tmp_path / "viewer"
        path.write_text(f"#!{sys.executable}\n{code}")
        path.chmod(0o755)
        monkeypatch.setattr(rerun_viewer, "viewer_program", lambda: path)
        monkeypatch.setattr(screenshot, "ViewerClient", SimpleNamespace(connect=client))
        monkeypatch.setattr(screenshot, "SETTLE_SECONDS", 0.0)

    return program


def test_a_recording_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording .*none\.rrd does not exist"):
        save_screenshot(tmp_path / "none.rrd", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("error", [TimeoutError, ConnectionError, RuntimeError])
def test_a_viewer_that_does_not_paint_in_its_time_is_asked_again(
    error: type[Exception],
    rrd: Path,
    viewer: Viewer,
    capsys: pytest.CaptureFixture[str],
) -> None:
    late = error("the viewer has not painted within 15 s")
    viewer(_SILENT, lambda _: client)
    client = Client(late, late, b"first", late, b"png")
    out = rrd.with_name("new") / "out.png"
    assert main([str(rrd), str(out), "--step", "7"]) == 0
    assert capsys.readouterr().out == f"written: {out}\n"
    assert out.read_bytes() == b"png"
    assert client.times == [{"timeline": "probe", "sequence": 7, "play_state": "paused"}]


def test_a_picture_is_taken_again_until_all_that_it_shows_is_loaded(
    rrd: Path, viewer: Viewer
) -> None:
    client = Client(b"first", b"loading.", b"loading..", b"all")
    viewer(_SILENT, lambda _: client)
    with headless_viewer(rrd) as shown:
        assert shown.picture() == b"all"


def test_a_view_is_found_by_its_name(rrd: Path, viewer: Viewer) -> None:
    client = Client(b"png")
    viewer(_SILENT, lambda _: client)
    with headless_viewer(rrd) as shown:
        client.asked.clear()
        shown.picture("Log")
    assert set(client.asked) == {"4"}


def test_a_viewer_that_never_paints_is_one_error(
    rrd: Path,
    viewer: Viewer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(screenshot, "LIMIT_SECONDS", 2.0)
    client = Client(TimeoutError("not painted\n  within 15 s"))
    viewer(_SILENT, lambda _: client)
    assert main([str(rrd), str(rrd.with_suffix(".png"))]) == 2
    assert capsys.readouterr().err == (
        "error: the Rerun viewer gave no picture: after 2 s, not painted within 15 s\n"
    )
    assert not rrd.with_suffix(".png").exists()


def test_a_viewer_that_hangs_is_given_up(
    rrd: Path, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screenshot, "LIMIT_SECONDS", 2.0)
    viewer(_SILENT, HangingClient)
    begun = time.monotonic()
    with pytest.raises(RecordingError, match="gave no picture: after 2 s, "):
        save_screenshot(rrd, rrd.with_suffix(".png"))
    assert time.monotonic() - begun < 60.0


def test_a_viewer_that_ends_is_quoted(
    rrd: Path, viewer: Viewer, capsys: pytest.CaptureFixture[str]
) -> None:
    viewer(_ENDING, Client)
    assert main([str(rrd), str(rrd.with_suffix(".png"))]) == 2
    assert capsys.readouterr().err == (
        "error: the Rerun viewer gave no picture: it ended: no\\x1b[31m graphics\n"
    )
