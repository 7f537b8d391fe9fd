"""CHSEL: the set of plausible poses of an object, from contacts and free space.

Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from Contact and
Free Space Data", Robotics: Science and Systems, 2023.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if os.path.exists(os.path.join(os.path.dirname(__file__), "wrapper.py")):  # a file of theirs
    raise ImportError(
        "package chsel of PyPI is installed beside this one, chsel-replay, and files of both are "
        "mixed, as both are imported as chsel; to mend it: pip uninstall -y chsel chsel-replay, "
        "and install chsel-replay again (each needs an environment of its own)"
    )

if TYPE_CHECKING:
    from chsel.api import register
    from chsel.cost import RelaxedCost
    from chsel.cost_settings import CostSettings
    from chsel.engine import CompiledCost
    from chsel.errors import ChselError, InputWarning, MeshWarning, PointsWarning
    from chsel.mesh import load_mesh
    from chsel.points import KnownPoints, Workspace
    from chsel.problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
    from chsel.sdf import SdfGrid

__all__ = [
    "ArchiveSnapshot",
    "ChselError",
    "CompiledCost",
    "CostSettings",
    "Hypotheses",
    "InputWarning",
    "KnownPoints",
    "MeshWarning",
    "PointsWarning",
    "RegistrationProblem",
    "RelaxedCost",
    "SdfGrid",
    "Workspace",
    "load_mesh",
    "register",
]

_PLACES = {
    "ArchiveSnapshot": "problem",
    "ChselError": "errors",
    "CompiledCost": "engine",
    "CostSettings": "cost_settings",
    "Hypotheses": "problem",
    "InputWarning": "errors",
    "KnownPoints": "points",
    "MeshWarning": "errors",
    "PointsWarning": "errors",
    "RegistrationProblem": "problem",
    "RelaxedCost": "cost",
    "SdfGrid": "sdf",
    "Workspace": "points",
    "load_mesh": "mesh",
    "register": "api",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that `replay info` need not wait for torch."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
