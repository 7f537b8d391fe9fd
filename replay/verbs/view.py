"""Make the Rerun recording from the MCAP file alone, and open it or save it."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path

from chsel.errors import RecordingError
from replay.arguments import chosen_steps, path_argument
from replay.console import Console, print_warning
from replay.files import require_new
from replay.mcap.reader import read_recording
from replay.rerun.rerun_recorder import draw_recording
from replay.rerun.viewer import has_screen, web_server, window

_STEP_HELP = "last probe to show, by default that of the recording"
_ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what to look at, and where."""
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
    if given.step is not None:
        chosen_steps(str(given.step), [probe.step for probe in recording.probes])
    console = Console()
    if recording.damage is not None:
        print_warning(f"{given.file} is {recording.damage}; what is whole of it is shown")
    if given.save is not None:
        draw_recording(recording, given.save, last=given.step)
        console.print(str(given.save), soft_wrap=True)
        return 0
    with tempfile.TemporaryDirectory(prefix="replay-view-") as folder:
        rrd = Path(folder) / "recording.rrd"
        draw_recording(recording, rrd, last=given.step)
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
