"""`python -m docs.pictures.screenshot FILE.rrd OUT.png [STEP]`: the Rerun viewer, without a screen.

Needs Vulkan: a graphics card's, or the software one (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import io
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

from docs.pictures.outlines import small_png
from replay.rerun.viewer import free_port, viewer_program, viewer_url

_LIMIT = 120.0  # seconds for one answer
_SETTLE = 8.0  # seconds until the layout stands and the notice of the start is gone
_MENU = 37  # height of the viewer's menu bar: about the machine, not the recording
Answer = TypeVar("Answer")


class Viewer:
    """A viewer that has read a recording."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._ask(self._check_loaded)
        time.sleep(_SETTLE)

    def picture(self, step: int | None = None, view: str | None = None) -> Image.Image:
        """All of it at a probe, or the view of this name; as soon as nothing changes any more."""
        if step is not None:
            self._ask(lambda client: client.set_time("probe", sequence=step, play_state="paused"))
        last, png = b"", self._ask(lambda client: _take(client, view))
        while png != last:
            last, png = png, self._ask(lambda client: _take(client, view))
        return Image.open(io.BytesIO(png)).convert("RGB")

    def _ask(self, question: Callable[[ViewerClient], Answer]) -> Answer:
        """Ask again until there is an answer: a busy viewer gives none in its own time."""
        deadline = time.monotonic() + _LIMIT
        while True:
            try:
                return question(ViewerClient.connect(viewer_url(self._port)))
            except (RuntimeError, OSError, ValueError):
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.5)

    @staticmethod
    def _check_loaded(client: ViewerClient) -> None:
        state = client.get_state()
        if state.loading or not any(shown.timelines for shown in state.recordings):
            raise RuntimeError("the viewer has not read its recording")


def _take(client: ViewerClient, name: str | None) -> bytes:
    if name is None:
        return client.take_screenshot()
    (found,) = [view.view_id for view in client.get_state().views if view.name == name]
    return client.take_screenshot(view_id=found)


@contextmanager
def viewer_on(rrd: Path, width: int = 1600, height: int = 900) -> Iterator[Viewer]:
    """A viewer of a size in points of the screen, until the end of the block."""
    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port)]
    command = [str(viewer_program()), *options, "--window-size", f"{width}x{height}", str(rrd)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield Viewer(port)
    finally:
        process.kill()
        process.wait()


def screenshot(rrd: Path, png: Path, step: int | None = None) -> None:
    """Write what the viewer shows below its menu, at a probe or where it opens."""
    with viewer_on(rrd) as viewer:
        picture = viewer.picture(step)
    small_png(picture.crop((0, _MENU, *picture.size)), png)


if __name__ == "__main__":
    screenshot(*map(Path, sys.argv[1:3]), *map(int, sys.argv[3:]))
