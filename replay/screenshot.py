"""A picture of a Rerun recording as the viewer shows it, without a screen."""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import rerun_cli
from rerun.experimental import ViewerClient

from chsel.errors import RecordingError

START_SECONDS = 60.0
ATTEMPTS = 5


def save_screenshot(
    rrd: Path, png: Path, *, step: int | None = None, width: int = 1600, height: int = 900
) -> None:
    """Save a picture of `rrd` at probe `step` (None: the last) as `png`, width x height points.

    Needs Vulkan: a graphics card, or the software one (Debian: mesa-vulkan-drivers). Raises
    RecordingError if the file is missing or no picture could be taken, with the viewer's reason.
    """
    if not rrd.is_file():
        raise RecordingError(f"recording {rrd} does not exist; accepted: a .rrd file")
    port = _free_port()
    viewer = _start(rrd.resolve(), port, f"{width}x{height}")
    try:
        client = _connect(viewer, port)
        picture = _picture(client, viewer, step)
    finally:
        viewer.kill()
        viewer.wait()
    png.parent.mkdir(parents=True, exist_ok=True)
    png.write_bytes(picture)


def _start(rrd: Path, port: int, size: str) -> subprocess.Popen[str]:
    """The viewer's own program, not its wrapper, so that ending it ends all of it."""
    program = Path(os.path.dirname(rerun_cli.__file__)) / "rerun"
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port)]
    return subprocess.Popen(
        [str(program), *options, "--window-size", size, str(rrd)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
