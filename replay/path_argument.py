"""The type of arguments that are paths."""

from __future__ import annotations

import os
from pathlib import Path


def path_argument(text: str) -> Path:
    """The path, with ~ for the home folder, which no shell expands in --save=~/FILE."""
    return Path(os.path.expanduser(text))
