"""Make the Rerun recording anew from the MCAP file alone, and open it or save it."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path

from chsel.errors import RecordingError
from replay.arguments import path_argument
from replay.console import Console
from replay.files import require_new
from replay.mcap.reader import Recording, read_recording
from replay.rerun.rerun_recorder import draw_recording
from replay.rerun.viewer import has_screen, web_server, window

_STEP_HELP = "last probe to show, by default that of the recording"


_ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to look at, and where."""
    parser.add_argument("file", type=path_argument, metavar="FILE", help="a recording.mcap")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--save", type=path_argument, metavar="RRD", help="write a new file, open nothing"
    )
    where.add_argument("--web", action="store_true", help="in a browser on this machine")
    parser.add_argument("--step", type=int, metavar="K", help=_STEP_HELP)


def run(given: argparse.Namespace) -> int:
    """Draw the recording and show it."""
    if given.save is not None:
        require_new(given.save)
    elif not given.web and not has_screen():
        raise RecordingError(
            f"there is no screen to show {given.file} on; accepted: --save OUT.rrd, or --web"
        )
    recording = read_recording(given.file, partial=True)
    _check_step(recording, given.step)
    console = Console()
    if recording.damage is not None:
        warnings = Console(stderr=True)
        what = f"warning: {given.file} is {recording.damage}; what is whole of it is shown"
        warnings.print(what, soft_wrap=True)
    if given.save is not None:
        _draw(recording, given.save, given.step)
        console.print(str(given.save), soft_wrap=True)
        return 0
    with tempfile.TemporaryDirectory(prefix="replay-view-") as folder:
        rrd = Path(folder) / "recording.rrd"
        _draw(recording, rrd, given.step)
        for number in _ENDINGS:  # that end the viewer and remove the folder, too
            signal.signal(number, lambda number, _: sys.exit(128 + number))
        if given.web:
            _show_in_browser(rrd, console)
        else:
            with suppress(KeyboardInterrupt), window(rrd) as viewer:
                viewer.wait()
    return 0


def _show_in_browser(rrd: Path, console: Console) -> None:
    """Serve the viewer until Ctrl-C."""
    with suppress(KeyboardInterrupt), web_server(rrd) as (server, address):
        console.print(address, soft_wrap=True)
        console.print("Ctrl-C ends it")
        if has_screen():  # else a browser for text might take the terminal over
            webbrowser.open(address)
        server.wait()


def _draw(recording: Recording, path: Path, last: int | None) -> None:
    progress = Console(stderr=True)
    if progress.is_terminal:
        with progress.status(f"drawing {len(recording.probes)} probes"):
            draw_recording(recording, path, last=last)
    else:
        draw_recording(recording, path, last=last)


def _check_step(recording: Recording, step: int | None) -> None:
    steps = sorted({probe.step for probe in recording.probes})
    if step is not None and step not in steps:
        accepted = f"{steps[0]} to {steps[-1]}" if steps else "none"
        raise RecordingError(
            f"recording {recording.path} has no probe {step}; accepted: {accepted}"
        )
