"""`python -m runners.gallery`: every picture of README and docs anew, from sessions run for them.

Needs PyBullet (Python 3.11) and Vulkan for the Rerun viewer without a screen (Debian:
mesa-vulkan-drivers). docs/results.md has its figures from `python -m runners.report`.
"""

from __future__ import annotations

import argparse
import io
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from chsel.errors import ChselError, RecordingError
from replay.console import Console, print_error
from replay.mcap.reader import Recording, read_recording
from replay.screenshot import headless_viewer, save_screenshot
from runners.reporting.fault_pictures import KINDS
from runners.reporting.figures import small_png
from runners.reporting.probing_animation import animation

REPOSITORY = Path(__file__).resolve().parents[1]
_MENU = 37  # height of the viewer's menu bar in a screenshot: about the machine, not the recording
_WINDOW = (1920, 1200)  # of the animation, of which two views are shown
_WIDTH = 720  # of the animation
_FRAME, _LAST_FRAME = 400, 2500  # milliseconds
_TEXT_SIZE, _TEXT_COLOR = 22.0, (230, 232, 236)
_KINEMATIC_DRILL = ("object=drill", "session=kinematic", "method=anchored")
_STEERED = ("policy=information", "policy.stop.spread=0.005")
_SCENE, _LEGEND = "Scene", "Legend"


def recording_png(sessions: Sessions) -> bytes:
    """The viewer as it opens on a session."""
    return _viewer(sessions.drill / "recording.rrd", sessions.folder)


def session_webp(sessions: Sessions) -> bytes:
    """The scene of the same session, probe by probe."""
    recording = read_recording(sessions.drill / "recording.mcap")
    width, height = _WINDOW
    frames = []
    rrd = sessions.drill / "recording.rrd"
    with headless_viewer(rrd, width=width, height=height) as viewer:
        for probe in recording.probes:
            viewer.go_to(probe.step)
            views = [_image(viewer.picture(name)) for name in (_SCENE, _LEGEND)]
            frames.append(_frame(views, _caption(recording, probe.step)))
    times = [_FRAME] * (len(frames) - 1) + [_LAST_FRAME]
    return animation(frames, times)


def comparison_png(sessions: Sessions) -> bytes:
    """Another method on the problems of the same session."""
    rrd = sessions.folder / "comparison.rrd"
    file = str(sessions.drill / "recording.mcap")
    _run("replay", "compare", file, "--methods", "gradient_descent", "--save-rerun", str(rrd))
    return _viewer(rrd, sessions.folder)


def anchored_png(sessions: Sessions) -> bytes:
    """The stages of method=anchored on a problem of another session."""
    folder = sessions.run("anchored", "object=drill", "session=kinematic", "recording=mcap")
    png = sessions.folder / "anchored.png"
    file = str(folder / "recording.mcap")
    _run("runners.reporting.anchored_stages", file, str(png), "--step", "4")
    return png.read_bytes()


def fault_png(sessions: Sessions, *, level: str) -> bytes:
    """What method=anchored makes of contacts with faults of one level."""
    folder = sessions.folder / "faults"
    _run("runners.reporting.fault_pictures", str(folder), "--levels", level)
    return (folder / f"{level}.png").read_bytes()


def next_probe_webp(sessions: Sessions) -> bytes:
    """A drill found on the paper's grid and by information, side by side."""
    starts = ("session.start_contacts=1", "session.start_probe=0")
    grid = sessions.run("grid", *_KINEMATIC_DRILL, *starts)
    steered = sessions.run("information", *_KINEMATIC_DRILL, *_STEERED)
    webp = sessions.folder / "next_probe.webp"
    files = {"grid": grid, "information": steered}
    named = [f"{title}={folder / 'recording.mcap'}" for title, folder in files.items()]
    _run("runners.reporting.probing_animation", str(webp), *named)
    return webp.read_bytes()


def next_probe_png(sessions: Sessions) -> bytes:
    """The viewer on the steered one of these sessions, at a decision."""
    folder = sessions.run("information", *_KINEMATIC_DRILL, *_STEERED)
    return _viewer(folder / "recording.rrd", sessions.folder, step=2)


def robot_log_png(sessions: Sessions) -> bytes:
    """The viewer on the log of a simulated robot."""
    log = sessions.folder / "drill.mcap"
    _run("runners.simulate_rig", "configuration=cabinet_drill", f"out={log}")
    files = [f"session.path={log}", f"session.pose={log.with_suffix('.truth.yaml')}"]
    choices = ["session=sensors", *files, "session/rig=cabinet"]
    folder = sessions.run("robot_log", *choices, "object=drill", "object.scale=1")
    return _viewer(folder / "recording.rrd", sessions.folder, step=1)


PICTURES: dict[str, Callable[[Sessions], bytes]] = {
    "replay/recording.png": recording_png,
    "replay/session.webp": session_webp,
    "replay/comparison.png": comparison_png,
    "docs/anchored.png": anchored_png,
    **{f"docs/real_data/{level}.png": partial(fault_png, level=level) for level in KINDS},
    "docs/robot_log.png": robot_log_png,
    "docs/next_probe.webp": next_probe_webp,
    "docs/next_probe.png": next_probe_png,
}
"""What makes the content of each file."""


class Sessions:
    """Runs sessions in a folder, each once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._folders: dict[str, Path] = {}

    @property
    def drill(self) -> Path:
        """The folder of the session that README starts with."""
        return self.run("drill", "object=drill", "method=chsel")

    def run(self, name: str, *choices: str) -> Path:
        """The folder that a session has written."""
        if name not in self._folders:
            logs = self.folder / name
            _run("runners.probe", *choices, f"logs={logs}")
            (self._folders[name],) = (logs / "probe").iterdir()
        return self._folders[name]


def _run(module: str, *arguments: str) -> None:
    command = ["python", "-m", module, *arguments]
    Console().print(shlex.join(command), soft_wrap=True)
    done = subprocess.run(
        [sys.executable, *command[1:]], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise RecordingError(f"{module} failed: {lines[-1] if lines else 'without a word'}")


def _viewer(rrd: Path, folder: Path, step: int | None = None) -> bytes:
    """What the viewer shows below its menu."""
    png = folder / "screenshot.png"
    save_screenshot(rrd, png, step=step)
    with Image.open(png) as picture:
        return small_png(picture.crop((0, _MENU, *picture.size)))


def _image(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png)).convert("RGB")


def _frame(views: list[Image.Image], caption: str) -> Image.Image:
    """Views below each other with a caption above, as wide as the animation."""
    width = views[0].width
    frame = Image.new("RGB", (width, sum(view.height for view in views)))
    top = 0
    for view in views:
        frame.paste(view, (0, top))
        top += view.height
    font = ImageFont.load_default(_TEXT_SIZE)
    ImageDraw.Draw(frame).text((16, 12), caption, fill=_TEXT_COLOR, font=font)
    return frame.resize((_WIDTH, round(frame.height * _WIDTH / width)), Image.Resampling.LANCZOS)


def _caption(recording: Recording, step: int) -> str:
    """The probe, and what was known after it."""
    contacts = sum(len(probe.contacts) for probe in recording.probes if probe.step <= step)
    return f"probe {step}: {contacts} contacts"


def main() -> int:
    """Make all pictures, or those that are named."""
    parser = argparse.ArgumentParser(prog="runners.gallery", description=__doc__)
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=f"of {', '.join(PICTURES)}")
    given = parser.parse_args()
    unknown = [name for name in given.pictures if name not in PICTURES]
    if unknown:
        parser.error(f"{unknown[0]} is not a picture; accepted: {', '.join(PICTURES)}")
    try:
        with tempfile.TemporaryDirectory(prefix="gallery-") as folder:
            sessions = Sessions(Path(folder))
            for name in given.pictures or PICTURES:
                content = PICTURES[name](sessions)
                (REPOSITORY / name).write_bytes(content)
                Console().print(f"{name}: {len(content) / 1000:.0f} kB")
    except (ChselError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
