"""The Rerun viewer on a finished recording, on this machine alone, as long as it is looked at."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import IO, NoReturn
from urllib.parse import quote

from rerun.experimental import ViewerClient

from chsel.errors import RecordingError
from replay.rerun.clock import PROBE
from replay.rerun.live import HOST, is_listening, viewer_program

_START_SECONDS = 60.0
_END_SECONDS = 5.0
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_SERVER_MEMORY = "50%"  # above its limit the server forgets what came first
_ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


def has_screen() -> bool:
    """Whether a window can be opened."""
    if sys.platform != "linux":
        return True
    return any(os.environ.get(name) for name in _SCREENS)


@contextmanager
def window(rrd: Path, *, step: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer in a window, at probe `step`; it ends with the block at latest.

    step: None is where the viewer opens. Raises RecordingError if it cannot be started.
    """
    port = free_port()
    options = ["--port", str(port), "--hide-welcome-screen", str(rrd.resolve())]
    with _running(options, port) as viewer:
        if step is not None:
            _go_to(step, viewer, port)
        yield viewer


@contextmanager
def web_server(rrd: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A server of the viewer to browsers on this machine, and the address; it ends with the block.

    Raises RecordingError if it cannot be started.
    """
    page, data = free_port(), free_port()
    ports = ["--web-viewer-port", str(page), "--port", str(data)]
    options = ["--serve-web", *ports, "--server-memory-limit", _SERVER_MEMORY, str(rrd.resolve())]
    source = f"rerun+http://{HOST}:{data}/proxy"
    with _running(options, page, data) as viewer:
        yield viewer, f"http://{HOST}:{page}/?url={quote(source, safe='')}"


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@contextmanager
def _running(options: list[str], *ports: int) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer from when it listens at all ports to the end of the block, whatever ends it."""
    command = [str(viewer_program()), "--bind", HOST, *options]
    with _endings_as_exceptions(), tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            deadline = time.monotonic() + _START_SECONDS
            while not all(map(is_listening, ports)):
                if viewer.poll() is not None or time.monotonic() > deadline:
                    raise RecordingError(f"the Rerun viewer does not start: {_last(output)}")
                time.sleep(0.1)
            yield viewer
            if viewer.poll() not in (None, 0):
                raise RecordingError(f"the Rerun viewer has ended: {_last(output)}")
        finally:
            _end(viewer)


def _go_to(step: int, viewer: subprocess.Popen[bytes], port: int) -> None:
    """Move the viewer to a probe, once it has read the file."""
    deadline = time.monotonic() + _START_SECONDS
    while viewer.poll() is None and time.monotonic() < deadline:
        try:
            client = ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
            state = client.get_state()
            if not state.loading and any(shown.timelines for shown in state.recordings):
                client.set_time(PROBE, sequence=step, play_state="paused")
                return
        except (RuntimeError, OSError, ValueError):
            pass  # it is not ready yet, or busy
        time.sleep(0.3)


def _end(viewer: subprocess.Popen[bytes]) -> None:
    viewer.terminate()
    try:
        viewer.wait(_END_SECONDS)
    except subprocess.TimeoutExpired:
        viewer.kill()
        viewer.wait()


def _last(output: IO[str]) -> str:
    """The last line that the viewer printed, which says why it ended."""
    output.seek(0)
    lines = [line.strip() for line in output.read().splitlines() if line.strip()]
    return lines[-1][-300:] if lines else "it says nothing"


@contextmanager
def _endings_as_exceptions() -> Iterator[None]:
    """Let whoever ends this process end what it has started: a signal unwinds the blocks."""

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    ours = [number for number in _ENDINGS if signal.getsignal(number) == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)
