"""Pictures of recordings."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from chsel.errors import RecordingError
from replay.rerun import headless
from replay.rerun.headless import headless_viewer
from replay.rerun.live import is_listening
from replay.screenshot import main, save_screenshot

# A viewer that listens at its port and answers nothing.
_SILENT = """
import socket, sys, time
server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
time.sleep(600)
"""


class HangingClient:
    """Waits for an answer as long as the viewer lives, as the real one does."""

    def __init__(self, url: str) -> None:
        self._address = ("127.0.0.1", int(url.rpartition(":")[2].partition("/")[0]))

    def get_state(self) -> None:
        with socket.create_connection(self._address) as asking:
            asking.recv(1)
        raise RuntimeError("transport error")


class Client:
    """A viewer that needs a while to read the file, and fails at the first picture of each kind."""

    def __init__(self) -> None:
        self.failures: list[Exception] = [
            RuntimeError("Viewer control timed out"),
            TimeoutError("deadline"),
            ConnectionError("refused"),
        ]
        self.times: list[dict[str, Any]] = []
        self.loading: list[bytes] = []  # signs of it on the next pictures

    def get_state(self) -> SimpleNamespace:
        if self.failures:
            raise self.failures.pop()
        views = [
            SimpleNamespace(name="Scene", view_id="3"),
            SimpleNamespace(name="Log", view_id="4"),
        ]
        return SimpleNamespace(
            loading=[], recordings=[SimpleNamespace(timelines=["probe"])], views=views
        )

    def take_screenshot(self, view_id: str | None = None) -> bytes:
        self.failures, failures = [], self.failures
        if failures:
            raise failures[0]
        what = b"all" if view_id is None else f"view {view_id}".encode()
        return what + self.loading.pop() if self.loading else what

    def set_time(self, timeline: str, **given: Any) -> None:
        self.times.append({"timeline": timeline, **given})


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Client:
    """In place of the viewer's own, to a program that only waits."""
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o700)
    client = Client()
    monkeypatch.setattr(headless, "viewer_program", lambda: program)
    monkeypatch.setattr(headless, "is_listening", lambda port: True)
    monkeypatch.setattr(headless.ViewerClient, "connect", lambda url: client)
    monkeypatch.setattr(headless, "SETTLE_SECONDS", 0.0)
    monkeypatch.setattr(headless, "_RETRY_SECONDS", 0.001)
    (tmp_path / "a.rrd").touch()
    return client


def test_a_recording_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording .*none\.rrd does not exist"):
        save_screenshot(tmp_path / "none.rrd", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def test_timeouts_of_the_viewer_are_survived(client: Client, tmp_path: Path) -> None:
    client.failures *= 3
    save_screenshot(tmp_path / "a.rrd", tmp_path / "new" / "out.png", step=7)
    assert (tmp_path / "new" / "out.png").read_bytes() == b"all"
    assert client.times == [{"timeline": "probe", "sequence": 7, "play_state": "paused"}]


def test_a_picture_is_taken_again_until_all_is_loaded(client: Client, tmp_path: Path) -> None:
    with headless_viewer(tmp_path / "a.rrd") as viewer:
        client.loading = [b".", b"..", b"..."]
        assert viewer.picture() == b"all"


def test_a_view_is_found_by_its_name(client: Client, tmp_path: Path) -> None:
    with headless_viewer(tmp_path / "a.rrd") as viewer:
        client.failures = [TimeoutError("deadline")]
        assert viewer.picture("Log") == b"view 4"


def test_a_viewer_that_never_answers_is_named_with_its_last_reason(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(headless, "START_SECONDS", 0.05)
    monkeypatch.setattr(client, "get_state", lambda: 1 / 0)
    monkeypatch.setattr(headless, "_FAILURES", (ArithmeticError,))
    with pytest.raises(RecordingError, match="gave no picture: division by zero"):
        save_screenshot(tmp_path / "a.rrd", tmp_path / "out.png")


def test_a_viewer_that_hangs_is_given_up(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "viewer").write_text(f"#!{sys.executable}\n{_SILENT}")
    monkeypatch.setattr(headless, "START_SECONDS", 2.0)
    monkeypatch.setattr(headless, "is_listening", is_listening)
    monkeypatch.setattr(headless.ViewerClient, "connect", HangingClient)
    with pytest.raises(RecordingError, match="gave no picture: "):
        save_screenshot(tmp_path / "a.rrd", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def test_a_viewer_that_ends_is_named_with_what_it_printed(client: Client, tmp_path: Path) -> None:
    (tmp_path / "viewer").write_text("#!/bin/sh\necho No graphics adapter was found\n")
    client.failures *= 1000
    with pytest.raises(RecordingError, match="found no Vulkan driver; accepted: a graphics card's"):
        save_screenshot(tmp_path / "a.rrd", tmp_path / "out.png")


def test_the_command_prints_one_line_without_controls(
    client: Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "viewer").write_text("#!/bin/sh\nprintf 'no \\033[31m graphics'\n")
    client.failures *= 1000
    assert main([str(tmp_path / "a.rrd"), str(tmp_path / "out.png")]) == 2
    expected = "error: the Rerun viewer gave no picture: it ended: no \\x1b[31m graphics\n"
    assert capsys.readouterr().err == expected
