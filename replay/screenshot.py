"""A picture of a Rerun recording as the viewer shows it, without a screen."""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from rerun.experimental import ViewerClient

from chsel.errors import RecordingError
from replay.console import print_error, print_written
from replay.rerun.clock import PROBE
from replay.rerun.viewer import free_port, is_listening, is_loaded, viewer_process, viewer_url

LIMIT_SECONDS = 120.0  # for one answer: the viewer gives up a picture after 15 s, and may hang
SETTLE_SECONDS = 8.0  # until the layout stands and the notice of the start is gone
_RETRY_SECONDS = 0.5
Answer = TypeVar("Answer")


def save_screenshot(
    rrd: Path, png: Path, *, step: int | None = None, width: int = 1600, height: int = 900
) -> None:
    """Save what the viewer shows of `rrd` at probe `step`, in points of a screen.

    step: None is where the viewer opens. Raises RecordingError as `headless_viewer` does.
    """
    with headless_viewer(rrd, width=width, height=height) as viewer:
        if step is not None:
            viewer.go_to(step)
        picture = viewer.picture()
    png.parent.mkdir(parents=True, exist_ok=True)
    png.write_bytes(picture)


@contextmanager
def headless_viewer(rrd: Path, *, width: int = 1600, height: int = 900) -> Iterator[HeadlessViewer]:
    """The viewer on `rrd`, in points of a screen that is not there; it ends with the block.

    Needs Vulkan: a graphics card's, or the software one (Debian: mesa-vulkan-drivers). On a busy
    machine the viewer may not paint in its own time; it is asked again. Raises RecordingError if
    the file does not exist or the viewer gives no answer within LIMIT_SECONDS, with the reason.
    """
    if not rrd.is_file():
        raise RecordingError(f"recording {rrd} does not exist; accepted: a .rrd file")
    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--port", str(port)]
    options += ["--window-size", f"{width}x{height}", str(rrd.resolve())]
    with viewer_process(options) as (viewer, output):
        yield HeadlessViewer(viewer, output, port)


class HeadlessViewer:
    """A viewer that has read a recording, and answers as long as its block lasts."""

    def __init__(self, viewer: subprocess.Popen[bytes], output: IO[str], port: int) -> None:
        self._viewer = viewer
        self._output = output
        self._port = port
        self._ask(_check_loaded)
        self._ask(lambda client: client.take_screenshot())
        time.sleep(SETTLE_SECONDS)

    def go_to(self, step: int) -> None:
        """Show a probe."""
        self._ask(lambda client: client.set_time(PROBE, sequence=step, play_state="paused"))

    def picture(self, view: str | None = None) -> bytes:
        """What the viewer shows as PNG: all of it, or the one view that has this name.

        It is taken again until nothing changes any more, as the viewer loads what it shows.
        """

        def take(client: ViewerClient) -> bytes:
            if view is None:
                return client.take_screenshot()
            (found,) = [v.view_id for v in client.get_state().views if v.name == view]
            return client.take_screenshot(view_id=found)

        last, picture = b"", self._ask(take)
        deadline = time.monotonic() + LIMIT_SECONDS
        while picture != last and time.monotonic() < deadline:
            last, picture = picture, self._ask(take)
        return picture

    def _ask(self, question: Callable[[ViewerClient], Answer]) -> Answer:
        """The answer; asks again until there is one, the viewer has ended or the time is over."""
        deadline = time.monotonic() + LIMIT_SECONDS
        # A call to a viewer that hangs has no time limit of its own: it ends with the viewer.
        late = threading.Timer(LIMIT_SECONDS + 1.0, self._viewer.kill)
        late.start()
        reason = "it does not answer"
        try:
            while time.monotonic() < deadline and self._viewer.poll() is None:
                try:
                    if is_listening(self._port):
                        return question(ViewerClient.connect(viewer_url(self._port)))
                except (RuntimeError, OSError, ValueError) as error:  # time-outs are OSErrors
                    reason = " ".join(str(error).split()) or type(error).__name__
                time.sleep(_RETRY_SECONDS)
        finally:
            late.cancel()
        if time.monotonic() >= deadline:
            reason = f"after {LIMIT_SECONDS:.0f} s, {reason}"
        elif self._viewer.poll() is not None:
            self._output.seek(0)
            reason = _reason_of_end(self._output.read())
        raise RecordingError(f"the Rerun viewer gave no picture: {reason}")


def _check_loaded(client: ViewerClient) -> None:
    if not is_loaded(client):
        raise RuntimeError("it found no recording in the file")


def _reason_of_end(text: str) -> str:
    """Why the viewer ended, from what it printed."""
    if "render context" in text or "No graphics adapter" in text:
        return "it found no Vulkan driver; accepted: a graphics card's, or mesa-vulkan-drivers"
    return f"it ended: {' '.join(text.split())[-300:]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m replay.screenshot FILE.rrd OUT.png`."""
    parser = argparse.ArgumentParser(prog="replay.screenshot", description=__doc__)
    parser.add_argument("rrd", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--step", type=int, help="probe to show; by default where the viewer opens")
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 900))
    given = parser.parse_args(arguments)
    width, height = given.size
    try:
        save_screenshot(given.rrd, given.png, step=given.step, width=width, height=height)
        print_written(given.png)
    except RecordingError as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
