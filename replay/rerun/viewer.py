"""The Rerun viewer on this machine alone: live, or on a recording while it is looked at."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, NoReturn
from urllib.parse import quote

import rerun as rr
import rerun_cli
from rerun.experimental import ViewerClient

from chsel.errors import RecordingError
from replay.rerun.clock import PROBE

HOST = "127.0.0.1"
LIVE_PORT = 9876
_LIVE_START_SECONDS = 20.0
_SCREEN_SECONDS = 1.0
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


def live_sink(port: int = LIVE_PORT) -> rr.GrpcSink | None:
    """Where to send a live recording: a viewer that listens already, or one that is started.

    None, with a warning, if there is no viewer and none can be started. The viewer outlives this
    process, so that its user can go on looking.
    """
    if not is_listening(port):
        reason = _start_live_viewer(port)
        if reason:
            warnings.warn(f"no live view: {reason}; the session goes on without", stacklevel=3)
            return None
    return rr.GrpcSink(viewer_url(port))


@contextmanager
def window(rrd: Path, *, step: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer in a window, at probe `step`; it ends with the block at latest.

    step: None is where the viewer opens. Raises RecordingError if it cannot be started.
    """
    port = free_port()
    with _listening(["--port", str(port), "--hide-welcome-screen", str(rrd.resolve())], port) as it:
        if step is not None:
            _go_to(step, it, port)
        yield it


@contextmanager
def web_server(rrd: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A server of the viewer to browsers on this machine, and the address; it ends with the block.

    Raises RecordingError if it cannot be started.
    """
    page, data = free_port(), free_port()
    ports = ["--web-viewer-port", str(page), "--port", str(data)]
    options = ["--serve-web", *ports, "--server-memory-limit", _SERVER_MEMORY, str(rrd.resolve())]
    with _listening(options, page, data) as server:
        yield server, f"http://{HOST}:{page}/?url={quote(viewer_url(data), safe='')}"


@contextmanager
def viewer_process(options: list[str]) -> Iterator[tuple[subprocess.Popen[bytes], IO[str]]]:
    """A viewer, and what it prints, until the end of the block, whatever ends it."""
    command = [str(viewer_program()), "--bind", HOST, *options]
    with _endings_as_exceptions(), tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            yield viewer, output
        finally:
            viewer.terminate()
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(_END_SECONDS)
            viewer.kill()
            viewer.wait()


def viewer_program() -> Path:
    """The viewer itself; the `rerun` command is a wrapper that outlives or orphans it."""
    return Path(rerun_cli.__file__).parent / "rerun"


def viewer_url(port: int) -> str:
    """Where a viewer that listens at a port takes data and orders."""
    return f"rerun+http://{HOST}:{port}/proxy"


def is_listening(port: int) -> bool:
    """Whether anything listens at a port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((HOST, port)) == 0


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def is_loaded(client: ViewerClient) -> bool:
    """Whether a viewer has read its recording."""
    state = client.get_state()
    return not state.loading and any(shown.timelines for shown in state.recordings)


@contextmanager
def _listening(options: list[str], *ports: int) -> Iterator[subprocess.Popen[bytes]]:
    """A viewer from when it listens at all ports to the end of the block."""
    with viewer_process(options) as (viewer, output):
        deadline = time.monotonic() + _START_SECONDS
        while not all(map(is_listening, ports)):
            if viewer.poll() is not None or time.monotonic() > deadline:
                raise RecordingError(f"the Rerun viewer does not start: {_last_line(output)}")
            time.sleep(0.1)
        yield viewer
        if viewer.poll() not in (None, 0):
            raise RecordingError(f"the Rerun viewer has ended: {_last_line(output)}")


def _go_to(step: int, viewer: subprocess.Popen[bytes], port: int) -> None:
    """Move the viewer to a probe, once it has read the file."""
    deadline = time.monotonic() + _START_SECONDS
    while viewer.poll() is None and time.monotonic() < deadline:
        with suppress(RuntimeError, OSError, ValueError):  # it is not ready yet, or busy
            client = ViewerClient.connect(viewer_url(port))
            if is_loaded(client):
                client.set_time(PROBE, sequence=step, play_state="paused")
                return
        time.sleep(0.3)


def _start_live_viewer(port: int) -> str | None:
    """Start a viewer and wait until it listens; the reason why there is none, or None."""
    program = viewer_program()
    options = ["--bind", HOST, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    try:
        viewer = subprocess.Popen(
            [str(program), *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        return f"the viewer {program.name} cannot be started ({error.strerror})"
    deadline = time.monotonic() + _LIVE_START_SECONDS
    while viewer.poll() is None and not is_listening(port) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not is_listening(port) and viewer.poll() is None:
        viewer.kill()
        return f"the viewer does not listen after {_LIVE_START_SECONDS:.0f} s"
    try:  # it listens first, and then finds out whether there is a screen
        status = viewer.wait(_SCREEN_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    return f"the viewer ended at once with status {status} (is there a screen?)"


def _last_line(output: IO[str]) -> str:
    """The last line that the viewer printed, which says why it ended."""
    output.seek(0)
    lines = [line.strip() for line in output.read().splitlines() if line.strip()]
    return lines[-1][-300:] if lines else "it says nothing"


@contextmanager
def _endings_as_exceptions() -> Iterator[None]:
    """End what this process has started when a signal ends it: a signal unwinds the blocks."""

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    can_handle = threading.current_thread() is threading.main_thread()
    endings = _ENDINGS if can_handle else []
    ours = [number for number in endings if signal.getsignal(number) == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)
