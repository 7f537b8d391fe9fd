"""Where a run writes, and what watches its registrations."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

from chsel.errors import RecordingError
from chsel.problem.settings import CheckedSettings, not_negative
from replay.files import whole_file


@dataclass(frozen=True)
class RecordingConfig(CheckedSettings):
    """Settings of recording a session."""

    mcap: bool = True  # write recording.mcap
    rerun: bool = True  # write recording.rrd
    live: bool = False  # show the session in the viewer while it runs
    # Iterations between archives; 0: the first and the last alone.
    snapshot_interval: Annotated[int, not_negative] = 25
    timings: bool = False
    """Also wall-clock seconds by stage, with which no two recordings are equal to the byte."""


def make_run_folder(logs: Path, *names: str) -> Path:
    """Make a folder TIME_NAME_NAME_ID in `logs`; the random id keeps two runs of a second apart.

    Of names, which may come from a file, only letters, digits and a few signs are taken.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    parts = [stamp, *(re.sub(r"[^\w.-]", "-", name)[:60] for name in names), os.urandom(2).hex()]
    folder = logs.expanduser() / "_".join(parts)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise RecordingError(
            f"run folder {folder} cannot be made ({error.strerror}); accepted: a writable logs=DIR"
        ) from None
    return folder


def write_in_run_folder(path: Path, text: str) -> None:
    """Write a file of a run. Raises WritingError, which names it, if that cannot be done."""
    with whole_file(path, "a logs=DIR that can be written") as beside:
        beside.write_text(text)
