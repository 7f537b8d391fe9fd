"""The Rerun viewer without a screen, for pictures of a recording."""

from __future__ import annotations

import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from rerun.experimental import ViewerClient

from chsel.errors import RecordingError
from replay.rerun.clock import PROBE
from replay.rerun.live import HOST, is_listening, viewer_program
from replay.rerun.viewer import free_port

LIMIT_SECONDS = 120.0  # for one answer: the viewer gives up a picture after 15 s, and may hang
SETTLE_SECONDS = 8.0  # until the layout stands and the notice of the start is gone
_RETRY_SECONDS = 0.5
Answer = TypeVar("Answer")


class HeadlessViewer:
    """A viewer that has read a recording, and answers as long as its block lasts."""

    def __init__(self, viewer: subprocess.Popen[bytes], output: IO[str], port: int) -> None:
        self._viewer = viewer
        self._output = output
        self._url = f"rerun+http://{HOST}:{port}/proxy"
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
                        return question(ViewerClient.connect(self._url))
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
    options = ["--headless", "--hide-welcome-screen", "--bind", HOST, "--port", str(port)]
    command = [str(viewer_program()), *options, "--window-size", f"{width}x{height}"]
    with tempfile.TemporaryFile("w+") as output:
        viewer = subprocess.Popen(
            [*command, str(rrd.resolve())], stdin=subprocess.DEVNULL, stdout=output, stderr=output
        )
        try:
            yield HeadlessViewer(viewer, output, port)
        finally:
            viewer.kill()
            viewer.wait()


def _check_loaded(client: ViewerClient) -> None:
    state = client.get_state()
    if state.loading or not any(shown.timelines for shown in state.recordings):
        raise RuntimeError("it found no recording in the file")


def _reason_of_end(text: str) -> str:
    """Why the viewer ended, from what it printed."""
    if "render context" in text or "No graphics adapter" in text:
        return "it found no Vulkan driver; accepted: a graphics card's, or mesa-vulkan-drivers"
    return f"it ended: {' '.join(text.split())[-300:]}"
