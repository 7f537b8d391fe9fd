"""Write hypotheses, points, archives, numbers, images or decisions as npz, csv or json."""

from __future__ import annotations

import argparse
import inspect
from pathlib import Path

from rich.filesize import decimal

from chsel.errors import SettingError
from replay.arguments import STEPS_HELP, path_argument
from replay.console import Console
from replay.content.export_content import EXPORTS, exported_archive
from replay.content.export_files import FORMATS, write_export
from replay.mcap.reader import read_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What, of which steps, in which form, where."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n\n".join(f"{name}: {inspect.getdoc(of)}" for name, of in EXPORTS.items())
    parser.add_argument("file", metavar="FILE", help="a recording")
    parser.add_argument("--what", required=True, choices=EXPORTS, help="what to write")
    parser.add_argument("--format", choices=FORMATS, help="npz, or as the name of OUT ends")
    parser.add_argument(
        "-o",
        "--out",
        type=path_argument,
        help="a new file; else RECORDING_WHAT.FORMAT in this folder",
    )
    parser.add_argument("--steps", metavar="A..B", help=STEPS_HELP)
    parser.add_argument(
        "--last", action="store_true", help="of the archives, the last of each step"
    )


def run(given: argparse.Namespace) -> int:
    """Write the file and say where it is."""
    file_format = _format(given.format, given.out)
    if given.last and given.what != "archive":
        raise SettingError(f"--last does not go with {given.what}; accepted: --what archive")
    recording = read_recording(given.file)
    if given.what == "archive":
        exported = exported_archive(recording, given.steps, last=given.last)
    else:
        exported = EXPORTS[given.what](recording, given.steps)
    path = given.out or Path(f"{recording.path.stem}_{given.what}.{file_format}")
    write_export(exported, path, file_format)
    console = Console(soft_wrap=True)
    console.print(f"{path}  {decimal(path.stat().st_size)}")
    if given.what == "points" and file_format != "json":
        lower, upper = recording.start.workspace.lower, recording.start.workspace.upper
        bounds = ",".join(f"[{a!r},{b!r}]" for a, b in zip(lower, upper, strict=True))
        console.print(
            f"probe with these: python -m runners.probe object=NAME session=points "
            f"session.path={path} 'session.workspace=[{bounds}]' "
            f"session.free_resolution={recording.start.free_resolution!r}",
        )
    return 0


def _format(named: str | None, out: Path | None) -> str:
    """The format that is asked for, by its name or by that of the file."""
    suffix = out.suffix.lower().removeprefix(".") if out is not None else ""
    if out is not None and suffix not in FORMATS:
        accepted = ", ".join(f".{name}" for name in FORMATS)
        raise SettingError(f"{out} ends in {out.suffix or 'no suffix'}; accepted: {accepted}")
    if named is not None and suffix not in ("", named):
        raise SettingError(f"--format is {named} and {out} ends in {suffix}; accepted: one of them")
    return named or suffix or "npz"
