"""Recordings: how they are written, read, checked, compared and run again."""

import sys
from pathlib import Path

if sys.argv[:1] == ["-m"] or Path(sys.argv[0] if sys.argv else "").stem.startswith("chsel-"):
    from replay.startup import begin

    begin()
