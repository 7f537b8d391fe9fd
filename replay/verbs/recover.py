"""Save everything whole of a damaged or unfinished recording as a finished one.

Status 0 if there was something to save, 2 if not.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from replay.arguments import path_argument
from replay.console import Console, plain_table
from replay.mcap.recovery import Recovered, recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The damaged file and the new one."""
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
    if found.damage is None:
        console.print("nothing is lost: the recording is whole")
    kept = f"{len(found.probes)} probes, {len(found.problems)} registration problems, "
    images = f", {found.images} images" if found.images else ""
    console.print(f"kept: {kept}{len(found.results)} results{images}")
    console.print(str(out))
    _print_losses(console, found)
    return 0


def _print_losses(console: Console, found: Recovered) -> None:
    if found.damage is None:
        return
    console.print(f"the file was not whole: it {found.damage}")
    if found.damages:
        table = plain_table("bytes lost", texts=("from", "to", "why"))
        for damage in found.damages:
            table.add_row(str(damage.start), str(damage.end), damage.reason)
        Console().print(table)
    if found.nothing_lost:
        console.print("nothing of the session is lost")
    if found.messages:
        console.print(f"lost messages: {found.messages}")
    if found.lost_probes:
        spans = [str(a) if a == b else f"{a} to {b}" for a, b in found.lost_probes]
        doubt = "" if found.complete else "at most "
        console.print(f"lost probes: {doubt}those of step {', '.join(spans)}")
    _print_steps(console, "lost registration problems", found.lost_problems)
    _print_steps(console, "lost results", found.lost_results)
    for name in found.remade:
        console.print(f"{name} was lost and is there again, made from the mesh, to the bit")
    for name in found.attachments:
        console.print(f"lost: {name}; what needs it says so")
    for event in found.events:
        console.print(f"lost: {event}")
    if not found.complete:
        console.print("the session's end is missing: what else was in it cannot be known")


def _print_steps(console: Console, what: str, steps: Sequence[int]) -> None:
    if steps:
        console.print(f"{what}: those of step {', '.join(map(str, steps))}")
