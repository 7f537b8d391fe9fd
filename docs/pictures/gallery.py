"""`python -m docs.pictures.gallery [NAME ...]`: pictures of README and docs, with their sessions.

Needs PyBullet (Python 3.11) and what docs.pictures.screenshot needs. Figures of docs/results are
from `python -m runners.report` and `python -m docs.pictures.sequence`.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from docs.pictures.animation import webp
from docs.pictures.screenshot import screenshot, viewer_on
from replay.mcap.reader import read_recording

_FAULTS = "clean noise_3mm quantised_5mm foreign_10 free_wrong camera_5mm mesh_2pct mixed"
_KINEMATIC = "object=drill session=kinematic method=anchored"
_STEERED = f"{_KINEMATIC} policy=information policy.stop.spread=0.005"
_ROBOT = "session=sensors session/rig=cabinet object=drill object.scale=1"


class Sessions:
    """Runs sessions in a folder, each once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def run(self, name: str, choices: str) -> Path:
        """The folder that a session has written."""
        logs = self.folder / name
        if not logs.exists():
            _run(f"runners.probe {choices} logs={logs}")
        (written,) = (logs / "probe").iterdir()
        return written

    def drill(self) -> Path:
        """That of the session that README starts with."""
        return self.run("drill", "object=drill method=chsel")


def _run(command: str) -> None:
    print("python -m", command)
    subprocess.run(
        [sys.executable, "-m", *shlex.split(command)], check=True, stdout=subprocess.DEVNULL
    )


def recording(sessions: Sessions) -> None:
    """The viewer on a session."""
    screenshot(sessions.drill() / "recording.rrd", Path("replay/recording.png"), step=4)


def session(sessions: Sessions) -> None:
    """The scene of the same session, probe by probe."""
    probes = read_recording(sessions.drill() / "recording.mcap").probes
    frames, contacts = [], 0
    with viewer_on(sessions.drill() / "recording.rrd", 1920, 1200) as viewer:
        for probe in probes:
            contacts += len(probe.contacts)
            frame = viewer.picture(probe.step, "Scene")
            text = f"probe {probe.step}: {contacts} contacts"
            font = ImageFont.load_default(22.0)
            ImageDraw.Draw(frame).text((16, 12), text, fill=(230, 232, 236), font=font)
            size = 720, round(frame.height * 720 / frame.width)
            frames.append(frame.resize(size, Image.Resampling.LANCZOS))
    webp(frames, [400] * (len(frames) - 1) + [2500], Path("replay/session.webp"))


def comparison(sessions: Sessions) -> None:
    """Another method on the problems of the same session."""
    rrd, file = sessions.folder / "comparison.rrd", sessions.drill() / "recording.mcap"
    _run(f"replay compare {file} --methods gradient_descent --save-rerun {rrd}")
    screenshot(rrd, Path("replay/comparison.png"), step=4)


def anchored(sessions: Sessions) -> None:
    """The stages of method=anchored."""
    folder = sessions.run("anchored", "object=drill session=kinematic recording=mcap")
    _run(f"docs.pictures.anchored_stages {folder / 'recording.mcap'} docs/anchored.png")


def real_data(sessions: Sessions) -> None:
    """What method=anchored makes of contacts with faults."""
    _run(f"docs.pictures.faults docs/real_data {_FAULTS}")


def robot_log(sessions: Sessions) -> None:
    """The viewer on the log of a simulated robot."""
    log = sessions.folder / "drill.mcap"
    _run(f"runners.simulate_rig configuration=cabinet_drill out={log}")
    files = f"session.path={log} session.pose={log.with_suffix('.truth.yaml')}"
    folder = sessions.run("robot_log", f"{_ROBOT} {files}")
    screenshot(folder / "recording.rrd", Path("docs/robot_log.png"), step=1)


def next_probe(sessions: Sessions) -> None:
    """A drill found on the paper's grid and by information, and the viewer at a decision."""
    grid = sessions.run("grid", f"{_KINEMATIC} session.start_contacts=1 session.start_probe=0")
    steered = sessions.run("information", _STEERED)
    named = f"grid={grid / 'recording.mcap'} information={steered / 'recording.mcap'}"
    _run(f"docs.pictures.animation docs/next_probe.webp {named}")
    screenshot(steered / "recording.rrd", Path("docs/next_probe.png"), step=2)


PICTURES = (recording, session, comparison, anchored, real_data, robot_log, next_probe)


def main(*names: str) -> None:
    """Make all pictures, or those that are named, from the repository's root."""
    with tempfile.TemporaryDirectory(prefix="gallery-") as folder:
        for picture in PICTURES:
            if not names or picture.__name__ in names:
                picture(Sessions(Path(folder)))


if __name__ == "__main__":
    main(*sys.argv[1:])
