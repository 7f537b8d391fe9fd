"""A picture of a Rerun recording as the viewer shows it, without a screen."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from rerun.experimental import ViewerClient

from chsel.errors import RecordingError
from replay.console import print_error
from replay.rerun.clock import PROBE
from replay.rerun.live import HOST, is_listening, viewer_program
from replay.rerun.viewer import free_port

LIMIT_SECONDS = 120.0  # for everything: the viewer gives up a picture after 15 s, and may hang
SETTLE_SECONDS = 8.0  # until the layout stands and the notice of the start is gone


def save_screenshot(
    rrd: Path, png: Path, *, step: int | None = None, width: int = 1600, height: int = 900
) -> None:
    """Save what the viewer shows of `rrd` at probe `step` (None: the last), in points of a screen.

    Needs Vulkan: a graphics card's, or the software one (Debian: mesa-vulkan-drivers). On a busy
    machine the viewer may not paint in its own time; it is asked again. Raises RecordingError if
    the file does not exist or no picture could be taken within LIMIT_SECONDS, with the reason.
    """
    if not rrd.is_file():
        raise RecordingError(f"recording {rrd} does not exist; accepted: a .rrd file")
    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--bind", HOST, "--port", str(port)]
    command = [str(viewer_program()), *options, "--window-size", f"{width}x{height}"]
    with tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen(
            [*command, str(rrd.resolve())], stdin=subprocess.DEVNULL, stdout=output, stderr=output
        )
        # A call to a viewer that hangs has no time limit of its own: it ends with the viewer.
        late = threading.Timer(LIMIT_SECONDS + 1.0, viewer.kill)
        late.start()
        try:
            picture = _picture(viewer, port, step, output)
        finally:
            late.cancel()
            viewer.kill()
            viewer.wait()
    png.parent.mkdir(parents=True, exist_ok=True)
    png.write_bytes(picture)


def _picture(
    viewer: subprocess.Popen[bytes], port: int, step: int | None, output: IO[str]
) -> bytes:
    """The picture as PNG; asks again until the viewer is ready or its time is over."""
    reason = "it does not answer"
    deadline = time.monotonic() + LIMIT_SECONDS
    settled: float | None = None  # when that is, once the viewer has painted
    while time.monotonic() < deadline and viewer.poll() is None:
        time.sleep(0.5)
        if not is_listening(port):
            continue
        try:
            client = ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
            state = client.get_state()
            if state.loading or not any(shown.timelines for shown in state.recordings):
                reason = "it found no recording in the file"
                continue
            if step is not None:
                client.set_time(PROBE, sequence=step, play_state="paused")
            if settled is None:
                client.take_screenshot()
                settled = time.monotonic() + SETTLE_SECONDS
            time.sleep(max(0.0, settled - time.monotonic()))
            return client.take_screenshot()
        except (RuntimeError, OSError, ValueError) as error:  # of them, time-outs are OSErrors
            reason = " ".join(str(error).split()) or type(error).__name__
    if time.monotonic() >= deadline:
        reason = f"after {LIMIT_SECONDS:.0f} s, {reason}"
    elif viewer.poll() is not None:
        output.seek(0)
        reason = _reason(output.read())
    raise RecordingError(f"the Rerun viewer gave no picture: {reason}")


def _reason(text: str) -> str:
    """Why the viewer ended, from what it printed."""
    if "render context" in text or "No graphics adapter" in text:
        return "it found no Vulkan driver; accepted: a graphics card's, or mesa-vulkan-drivers"
    return f"it ended: {' '.join(text.split())[-300:]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m replay.screenshot FILE.rrd OUT.png`."""
    parser = argparse.ArgumentParser(prog="replay.screenshot", description=__doc__)
    parser.add_argument("rrd", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--step", type=int, help="probe to show; by default the last")
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 900))
    given = parser.parse_args(arguments)
    width, height = given.size
    try:
        save_screenshot(given.rrd, given.png, step=given.step, width=width, height=height)
    except (RecordingError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
