"""The physics engines, PyBullet and MuJoCo, imported where a program needs one and nowhere else."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from chsel.errors import SessionError

ENGINES = ("pybullet", "mujoco")
"""Names of the physics engines, which are those of their modules."""
_OUTPUTS = (1, 2)
_INSTALL = "pip install -e '.[sim]' where the project is"
_WITHOUT = "session=kinematic, the same session without a physics engine"


def default_engine() -> str:
    """Return the engine of a session that names none: PyBullet where it is installed."""
    return "mujoco" if find_spec("pybullet") is None else "pybullet"


def with_engine(session: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of a session, a simulated one with the name of its engine."""
    if session.get("kind") != "simulated" or session.get("engine") is not None:
        return dict(session)
    return {**session, "engine": default_engine()}


def require_engine(name: str) -> None:
    """Raise SessionError if an engine is not installed."""
    if find_spec(name) is not None:
        return
    others = [f"session.engine={other}" for other in ENGINES if find_spec(other) is not None]
    raise SessionError(
        f"the physics engine {name} is not installed ({_INSTALL}); accepted: "
        f"{' or '.join([*others, _WITHOUT])}"
    )


def import_mujoco() -> Any:
    """Return the module mujoco. Raise SessionError where it is not installed."""
    require_engine("mujoco")
    import mujoco

    return mujoco


def connect() -> Any:
    """Return a new world of PyBullet. Raise SessionError where it is not installed."""
    require_engine("pybullet")
    with silent():
        try:
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
        except ImportError as error:  # as of one that was built for another numpy
            reason = " ".join(str(error).split())
            raise SessionError(
                f"the physics engine pybullet is installed and cannot be imported ({reason}); "
                f"accepted: session.engine=mujoco or {_WITHOUT}"
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
