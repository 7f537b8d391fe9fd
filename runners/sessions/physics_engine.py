"""PyBullet, imported where a program needs it and nowhere else."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from chsel.errors import SessionError

_OUTPUTS = (1, 2)


def connect(instead: str) -> Any:
    """Return a new world; SessionError, which says what to do `instead`, without PyBullet."""
    with silent():
        try:
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
        except ImportError:
            raise SessionError(
                "PyBullet is not installed (pip install -e '.[sim]' where the project is; it has "
                f"wheels for Python 3.11 only); {instead}"
            ) from None
        return BulletClient(pybullet.DIRECT)


@contextmanager
def silent() -> Iterator[None]:
    """Swallow what compiled code prints meanwhile: PyBullet greets, and VHACD reports at length."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    kept = [os.dup(descriptor) for descriptor in _OUTPUTS]
    with open(os.devnull, "w") as nowhere:
        for descriptor in _OUTPUTS:
            os.dup2(nowhere.fileno(), descriptor)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C still holds back
        for descriptor, copy in zip(_OUTPUTS, kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
