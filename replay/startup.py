"""The first moments of a command: its imports, which take seconds, end quietly on Ctrl-C.

And a check that `chsel` is this project's package: the authors' published one has the same name.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

THEIRS = "wrapper.py"  # a file of the published package that ours does not have
OURS = "api.py"
WRONG_PACKAGE = (
    "the package chsel in {} is not this project's, or has files of PyPI's chsel among its own, as "
    "both have one name; to mend it: pip uninstall -y chsel chsel-replay, and install this project "
    "again, in an environment of its own"
)

EXTRAS = {
    "torch": ("torch",),
    "sim": ("mujoco", "pooch", "pybullet", "requests"),
    "files": ("cascadio", "pypcd4"),
    "sensors": ("PIL", "mcap_ros2", "rosbags", "yourdfpy"),
    "serve": ("aiohttp",),
    "evaluate": ("bokeh", "cryptography", "dask", "distributed", "markdown_it", "matplotlib"),
}
"""The modules that each extra of this package installs."""


def begin() -> None:
    """Begin a command, before its imports: Ctrl-C ends it at once, and `chsel` must be ours.

    A console script imports nothing from the current folder, nor does a Python that it starts. A
    module of an extra that is not installed is an error of one line.
    """
    sys.excepthook = _name_missing_extra
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


def _name_missing_extra(  # noqa: PLR0917
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    name = ((error.name or "") if isinstance(error, ModuleNotFoundError) else "").split(".")[0]
    extra = next((extra for extra, names in EXTRAS.items() if name in names), None)
    if extra is None:
        sys.__excepthook__(kind, error, trace)
        return
    sys.stderr.write(
        f"error: {name} is not installed; accepted: after pip install 'chsel-replay[{extra}]', in "
        f"a checkout pip install -e '.[{extra}]'\n"
    )
    sys.stderr.flush()
    os._exit(2)  # an exception hook has no other way to a status


def ready() -> None:
    """End the imports: Ctrl-C raises KeyboardInterrupt, unless it is ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def package_version(package: str = "chsel-replay") -> str:
    """Return the version of an installed package, "not installed" without one."""
    import importlib.metadata  # a third of what `python -m replay --help` would take

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
