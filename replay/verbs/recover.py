"""Save everything whole of a damaged or unfinished recording as a finished one.

Status 0 if there was something to save, 2 if not.
"""

from __future__ import annotations

import argparse

from replay.arguments import path_argument
from replay.console import Console
from replay.mcap.recovery import recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the damaged file and the new one."""
    parser.add_argument("file", metavar="FILE", type=path_argument, help="a recording.mcap")
    parser.add_argument(
        "-o",
        "--out",
        metavar="OUT",
        type=path_argument,
        required=True,
        help="a new file; never overwrites",
    )


def run(given: argparse.Namespace) -> int:
    """Write the new recording, and print what was kept and what was lost."""
    path, out = given.file.expanduser(), given.out.expanduser()
    found = recover(path, out)
    console = Console(soft_wrap=True)
    if found.damage is not None:
        console.print(f"the file was not whole: it is {found.damage}")
    elif not found.lost:
        console.print("nothing is lost: the recording is whole")
    images = f", {found.images} images" if found.images else ""
    console.print(
        f"kept: {len(found.probes)} probes, {len(found.problems)} registration problems, "
        f"{len(found.results)} results{images}"
    )
    if found.remade:
        console.print("the SDF grid was damaged and is made again from the mesh, to the bit")
    for what, reason in found.lost.items():
        console.print(f"lost: {what}: {reason}")
    if not found.ended:
        console.print("the session's end is missing: what else was in it cannot be known")
    console.print(str(out))
    return 0
