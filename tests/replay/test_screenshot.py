"""Pictures of recordings."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from chsel.errors import RecordingError
from replay.rerun import headless
from replay.rerun.headless import headless_viewer
from replay.screenshot import save_screenshot


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


def test_a_viewer_that_ends_is_named_with_what_it_printed(client: Client, tmp_path: Path) -> None:
    (tmp_path / "viewer").write_text("#!/bin/sh\necho No graphics adapter was found\n")
    client.failures *= 1000
    with pytest.raises(RecordingError, match="found no Vulkan driver; accepted: a graphics card's"):
        save_screenshot(tmp_path / "a.rrd", tmp_path / "out.png")
