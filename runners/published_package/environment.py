"""The virtual environment of the published package."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from chsel.errors import ChselError

PUBLISHED = "0.2.1"


class PackageError(ChselError):
    """The published package cannot be installed, started or run."""


@dataclass(frozen=True)
class PackageConfig:
    """Where the published package is."""

    python: str | None = None  # an interpreter that has the package
    directory: str = "~/.cache/chsel/published"  # else, where its environment is, or is made
    pip: tuple[str, ...] = ()  # more arguments for pip, such as "--index-url=URL"


def interpreter(config: PackageConfig, say: Callable[[str], None]) -> Path:
    """The interpreter that has the package; its environment is made first if there is none.

    The environment has torch in the version and build of ours.
    """
    if config.python is not None:
        return Path(config.python).expanduser()
    directory = Path(config.directory).expanduser()
    finished = directory / f"chsel-{PUBLISHED}"
    python = directory / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not finished.exists():
        torch = f"torch=={version('torch')}"
        say(f"making an environment for chsel {PUBLISHED} in {directory}, once: some minutes")
        _run("venv", [sys.executable, "-m", "venv", str(directory)])
        install = [str(python), "-m", "pip", "install", "--quiet", *config.pip]
        for packages in ([torch], [torch, f"chsel=={PUBLISHED}"]):
            say(f"installing {packages[-1]}")
            _run("pip", [*install, *packages])
        finished.touch()
    return python


def _run(what: str, command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise PackageError(f"{what} does not run: {error}") from None
    if done.returncode:
        raise PackageError(
            f"{what} failed: {last_line(done.stderr or done.stdout)}; accepted: "
            "package.python=PATH of an interpreter that has the package, package.pip=[OPTION,...] "
            "for pip, or package.skip=true"
        )


def last_line(text: str) -> str:
    """What an error output says, in one line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return (errors or lines or ["no message"])[-1]
