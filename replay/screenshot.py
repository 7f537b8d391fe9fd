"""A picture of a Rerun recording as the viewer shows it, without a screen."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from chsel.errors import RecordingError
from replay.console import print_error
from replay.rerun.headless import headless_viewer


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
    except RecordingError as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
