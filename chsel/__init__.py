"""CHSEL: the set of plausible poses of an object, from contacts and free space.

Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from Contact and
Free Space Data", Robotics: Science and Systems, 2023.
"""

import os
from typing import Any

import lazy_loader

if os.path.exists(os.path.join(os.path.dirname(__file__), "wrapper.py")):  # a file of theirs
    raise ImportError(
        f"the package chsel in {os.path.dirname(__file__)} is not this project's, or has files of "
        "PyPI's chsel among its own, as both have one name; to mend it: pip uninstall -y chsel "
        "chsel-replay, and install this project again, in an environment of its own"
    )

# Names are imported when they are asked for: `replay info` need not wait for kernels and torch.
_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("chsel-replay")
    return _imported(name)
