"""The Rerun viewer on this machine alone: live, or on a recording while it is looked at."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO
from urllib.parse import quote

import rerun as rr
import rerun_cli

from chsel.errors import RecordingError

HOST = "127.0.0.1"
LIVE_PORT = 9876
_START_SECONDS = 60.0
_END_SECONDS = 5.0
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_SERVER_MEMORY = "50%"  # above its limit the server forgets what came first


def has_screen() -> bool:
    """Return whether a window can be opened."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in _SCREENS)


def live_sink(port: int = LIVE_PORT) -> rr.GrpcSink | None:
    """Return the sink of a live recording: a viewer that listens already, or a new one.

    None, with a warning, if there is no viewer and none can be started. The viewer outlives this
    process, so that its user can go on looking.
    """
    if not is_listening(port):
        try:
            if not has_screen():
                raise RecordingError("there is no screen")
            options = ["--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
            with tempfile.TemporaryFile("w+") as output:
                _start(options, output, port, outlives=True)
        except RecordingError as error:
            warnings.warn(f"no live view: {error}; the session goes on without", stacklevel=3)
            return None
    return rr.GrpcSink(viewer_url(port))


@contextmanager
def window(rrd: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Return the viewer in a window; it ends with the block at latest.

    Raise RecordingError if it cannot be started, or ends by an error.
    """
    port = free_port()
    with _viewer(
        ["--port", str(port), "--hide-welcome-screen", str(rrd.resolve())], port
    ) as viewer:
        yield viewer


@contextmanager
def web_server(rrd: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Open a server of the viewer to browsers on this machine, which ends with the block.

    Raise RecordingError if it cannot be started, or ends by an error.
    """
    page, data = free_port(), free_port()
    ports = ["--web-viewer-port", str(page), "--port", str(data)]
    options = ["--serve-web", *ports, "--server-memory-limit", _SERVER_MEMORY, str(rrd.resolve())]
    with _viewer(options, page, data) as server:
        yield server, f"http://{HOST}:{page}/?url={quote(viewer_url(data), safe='')}"


def viewer_program() -> Path:
    """Return the viewer itself; the `rerun` command is a wrapper that outlives or orphans it."""
    return Path(rerun_cli.__file__).parent / "rerun"


def viewer_url(port: int) -> str:
    """Return the address at which a viewer that listens at a port takes data and orders."""
    return f"rerun+http://{HOST}:{port}/proxy"


def is_listening(port: int) -> bool:
    """Return whether anything listens at a port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((HOST, port)) == 0


def free_port() -> int:
    """Return a port of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@contextmanager
def _viewer(options: list[str], *ports: int) -> Iterator[subprocess.Popen[bytes]]:
    """Return a viewer that listens at ports until the end of the block, whatever ends it."""
    with tempfile.TemporaryFile("w+") as output:
        viewer = _start(options, output, *ports)
        try:
            yield viewer
            if viewer.poll() not in (None, 0):
                raise RecordingError(f"the Rerun viewer has ended: {_last_line(output)}")
        finally:
            viewer.terminate()
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(_END_SECONDS)
            viewer.kill()
            viewer.wait()


def _start(
    options: list[str], output: IO[str], *ports: int, outlives: bool = False
) -> subprocess.Popen[bytes]:
    """Return a viewer, once it listens at all ports. Raise RecordingError if it does not."""
    command = [str(viewer_program()), "--bind", HOST, *options]
    try:
        viewer = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=outlives,
        )
    except OSError as error:
        raise RecordingError(f"{command[0]} cannot be started ({error.strerror})") from None
    deadline = time.monotonic() + _START_SECONDS
    while not all(map(is_listening, ports)):
        if viewer.poll() is not None or time.monotonic() > deadline:
            viewer.kill()
            raise RecordingError(f"the Rerun viewer does not start: {_last_line(output)}")
        time.sleep(0.1)
    return viewer


def _last_line(output: IO[str]) -> str:
    """Return the last line that the viewer printed, which says why it ended."""
    output.seek(0)
    lines = [line.strip() for line in output if line.strip()]
    return lines[-1][-300:] if lines else "it says nothing"
