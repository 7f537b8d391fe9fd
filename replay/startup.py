"""The first moments of a command: its imports, which take seconds, end quietly on Ctrl-C.

And a check that `chsel` is this project's package: the authors' published one has the same name.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

THEIRS = "wrapper.py"  # a file of the published package that ours does not have
OURS = "api.py"
WRONG_PACKAGE = (
    "the package chsel in {} is not this project's, or has files of PyPI's chsel among its own, as "
    "both have one name; to mend it: pip uninstall -y chsel chsel-replay, and install this project "
    "again, in an environment of its own"
)


def begin() -> None:
    """For a command, before its imports: Ctrl-C ends it at once, and `chsel` must be ours.

    A console script imports nothing from the current folder, nor does a Python that it starts.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.argv[:1] != ["-m"]:
        os.environ["PYTHONSAFEPATH"] = "1"
    spec = find_spec("chsel")  # it is not imported
    places = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    files = {name for place in places for name in (OURS, THEIRS) if (place / name).is_file()}
    if files != {OURS}:
        sys.stderr.write(f"error: {WRONG_PACKAGE.format(places[0] if places else 'no folder')}\n")
        sys.exit(2)


def ready() -> None:
    """Imports are done: Ctrl-C raises KeyboardInterrupt again, unless it is ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def package_version(package: str = "chsel-replay") -> str:
    """The version of an installed package, "not installed" without one."""
    import importlib.metadata  # a third of what `python -m replay --help` would take

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
