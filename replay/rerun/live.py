"""A viewer that watches a session as it happens, on this machine alone."""

from __future__ import annotations

import socket
import subprocess
import time
import warnings
from pathlib import Path

import rerun as rr
import rerun_cli

HOST = "127.0.0.1"
PORT = 9876
_START_SECONDS = 20.0
_SCREEN_SECONDS = 1.0


def live_sink(port: int = PORT) -> rr.GrpcSink | None:
    """Where to send a live recording: a viewer that listens already, or one that is started.

    None, with a warning, if there is no viewer and none can be started. The viewer outlives this
    process, so that its user can go on looking.
    """
    if not is_listening(port):
        reason = _start_viewer(port)
        if reason:
            warnings.warn(f"no live view: {reason}; the session goes on without", stacklevel=3)
            return None
    return rr.GrpcSink(f"rerun+http://{HOST}:{port}/proxy")


def viewer_program() -> Path:
    """The viewer itself; the `rerun` command is a wrapper that outlives or orphans it."""
    return Path(rerun_cli.__file__).parent / "rerun"


def is_listening(port: int) -> bool:
    """Whether anything listens at a port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((HOST, port)) == 0


def _start_viewer(port: int) -> str | None:
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
    deadline = time.monotonic() + _START_SECONDS
    while viewer.poll() is None and not is_listening(port) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not is_listening(port) and viewer.poll() is None:
        viewer.kill()
        return f"the viewer does not listen after {_START_SECONDS:.0f} s"
    try:  # it listens first, and then finds out whether there is a screen
        status = viewer.wait(_SCREEN_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    return f"the viewer ended at once with status {status} (is there a screen?)"
