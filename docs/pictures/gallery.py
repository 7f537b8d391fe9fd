"""`python -m docs.pictures.gallery [FILE ...]`: pictures of README and docs, with their sessions.

Run from the repository's root. Needs PyBullet (Python 3.11) and Vulkan: a graphics card's, or the
software one (Debian: mesa-vulkan-drivers). Figures of docs/results are from `python -m
runners.report` and `python -m docs.pictures.draw sequence`.
"""

from __future__ import annotations

import io
import shlex
import subprocess
import sys
import tempfile
import time
from collections import ChainMap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from rerun.experimental import ViewerClient

from docs.pictures.draw import small_png, webp
from replay.mcap.reader import read_recording
from replay.rerun.viewer import free_port, viewer_program, viewer_url

_LEVELS = ("clean", "noise_3mm", "quantised_5mm", "foreign_10")
_LEVELS += ("free_wrong", "camera_5mm", "mesh_2pct", "mixed")
_DRILL = "runners.probe logs={here} object=drill"
_FAULTY = "runners.probe logs={here} object=mustard session=kinematic method=anchored seed=2"
_MAKES = {  # what pictures are made of: the folder {here}, or that of the session in it
    "drill": f"{_DRILL} method=chsel",
    "anchored": f"{_DRILL} session=kinematic",
    "grid": f"{_DRILL} session=kinematic method=anchored session.start_contacts=1 "
    "session.start_probe=0",
    "steered": f"{_DRILL} session=kinematic policy=information policy.stop.spread=0.005",
    "log": "runners.simulate_rig configuration=cabinet_drill out={here}/drill.mcap",
    "robot": f"{_DRILL} object.scale=1 session=sensors session/rig=cabinet "
    "session.path={log}/drill.mcap session.pose={log}/drill.truth.yaml",
    "compared": "replay compare {drill}/recording.mcap --methods gradient_descent "
    "--save-rerun {here}/recording.rrd",
    **{one: f"{_FAULTY} session.start_probe=10 session/faults={one}" for one in _LEVELS},
}
_DRAWN = {
    "docs/anchored.png": "stages docs/anchored.png {anchored}/recording.mcap",
    "docs/next_probe.webp": "animation docs/next_probe.webp grid={grid}/recording.mcap "
    "information={steered}/recording.mcap",
    **{
        f"docs/real_data/{one}.png": f"faults docs/real_data/{one}.png {{{one}}}/recording.mcap"
        for one in _LEVELS
    },
}
_SHOWN = {  # by the viewer, at a probe
    "replay/recording.png": ("drill", 4),
    "replay/comparison.png": ("compared", 4),
    "docs/robot_log.png": ("robot", 1),
    "docs/next_probe.png": ("steered", 2),
}
_LIMIT = 120.0  # seconds for one answer
_SETTLE = 8.0  # seconds until the viewer's layout stands and the notice of the start is gone
_MENU = 37  # height of the viewer's menu bar: about the machine, not the recording


class _Made(dict[str, str]):
    """The folders of what was made, each when it is first asked for."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def __missing__(self, name: str) -> str:
        here = self._folder / name
        here.mkdir()
        run(_MAKES[name].format_map(ChainMap({"here": str(here)}, self)))
        self[name] = str(next(here.glob("probe/*"), here))
        return self[name]


def run(command: str) -> None:
    """Run a module with its arguments."""
    print("python -m", command)
    words = [sys.executable, "-m", *shlex.split(command)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


@contextmanager
def viewer_on(folder: str, size: str) -> Iterator[int]:
    """The port of a viewer without a screen that has read the recording in a folder."""
    port = free_port()
    rrd = f"{folder}/recording.rrd"
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port)]
    command = [str(viewer_program()), *options, "--window-size", size, rrd]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while (state := asked(port, ViewerClient.get_state)).loading or not state.recordings:
            time.sleep(0.5)
        time.sleep(_SETTLE)
        yield port
    finally:
        process.kill()
        process.wait()


def asked(port: int, question: Callable[[ViewerClient], Any]) -> Any:
    """Ask again until there is an answer: a busy viewer gives none in its own time."""
    deadline = time.monotonic() + _LIMIT
    while True:
        try:
            return question(ViewerClient.connect(viewer_url(port)))
        except (RuntimeError, OSError, ValueError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def picture(port: int, step: int, **shown: Any) -> Image.Image:
    """What is shown at a probe, as soon as nothing changes any more."""
    asked(port, lambda client: client.set_time("probe", sequence=step, play_state="paused"))
    last = b""
    png = asked(port, lambda client: client.take_screenshot(**shown))
    while png != last:
        last = png
        png = asked(port, lambda client: client.take_screenshot(**shown))
    return Image.open(io.BytesIO(png)).convert("RGB")


def session(folder: str, path: str) -> None:
    """The scene of a session, probe by probe."""
    frames = []
    contacts = 0
    font = ImageFont.load_default(22.0)
    with viewer_on(folder, "1920x1200") as port:
        views = asked(port, lambda client: client.get_state().views)
        (scene,) = [view.view_id for view in views if view.name == "Scene"]
        for probe in read_recording(f"{folder}/recording.mcap").probes:
            contacts += len(probe.contacts)
            frame = picture(port, probe.step, view_id=scene)
            text = f"probe {probe.step}: {contacts} contacts"
            ImageDraw.Draw(frame).text((16, 12), text, fill="#e6e8ec", font=font)
            size = 720, round(frame.height * 720 / frame.width)
            frames.append(frame.resize(size, Image.Resampling.LANCZOS))
    webp(frames, [400] * (len(frames) - 1) + [2500], path=path)


def main(*names: str) -> None:
    """Make all pictures, or the files that are named."""
    with tempfile.TemporaryDirectory(prefix="gallery-") as folder:
        made = _Made(folder)
        for path in names or ("replay/session.webp", *_DRAWN, *_SHOWN):
            if path in _DRAWN:
                run(f"docs.pictures.draw {_DRAWN[path].format_map(made)}")
            elif path in _SHOWN:
                name, step = _SHOWN[path]
                with viewer_on(made[name], "1600x900") as port:
                    whole = picture(port, step)
                small_png(whole.crop((0, _MENU, *whole.size)), path)
            else:
                session(made["drill"], path)


if __name__ == "__main__":
    main(*sys.argv[1:])
