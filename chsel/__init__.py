"""CHSEL: the set of plausible poses of an object, from contacts and free space.

Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from Contact and
Free Space Data", Robotics: Science and Systems, 2023.
"""

# ruff: noqa: F401

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if os.path.exists(os.path.join(os.path.dirname(__file__), "wrapper.py")):  # a file of theirs
    raise ImportError(
        f"the package chsel in {os.path.dirname(__file__)} is not this project's, or has files of "
        "PyPI's chsel among its own, as both have one name; to mend it: pip uninstall -y chsel "
        "chsel-replay, and install this project again, in an environment of its own"
    )

if TYPE_CHECKING:  # the same, for type checkers and editors
    from chsel.api import register
    from chsel.cost.compiled_cost import CompiledCost
    from chsel.cost.cost_settings import CostSettings
    from chsel.cost.torch_cost import RelaxedCost
    from chsel.errors import ChselError, InputWarning, MeshWarning, PointsWarning
    from chsel.methods import build_method
    from chsel.next_probe.action_lattice import (
        ActionSettings,
        around_actions,
        forward_actions,
        straight_actions,
    )
    from chsel.next_probe.decision_problem import (
        Actions,
        Belief,
        Decision,
        DecisionProblem,
        HandShape,
    )
    from chsel.numerics.threads import set_threads
    from chsel.policies import build_policy
    from chsel.policies.steering import Steering
    from chsel.problem.mesh import load_mesh
    from chsel.problem.online_registration import OnlineRegistration
    from chsel.problem.points import KnownPoints, Workspace
    from chsel.problem.registration_problem import (
        ArchiveSnapshot,
        Hypotheses,
        RegistrationProblem,
        Trust,
    )
    from chsel.problem.sdf_grid import SdfGrid
    from chsel.problem.trust import trust_in
    from chsel.sensing.free_space import FreeGrid, interior_lattice, poses_between

    __version__: str

_NAMES = {
    "api": "register",
    "cost.compiled_cost": "CompiledCost",
    "cost.cost_settings": "CostSettings",
    "cost.torch_cost": "RelaxedCost",
    "errors": "ChselError InputWarning MeshWarning PointsWarning",
    "methods": "build_method",
    "next_probe.action_lattice": "ActionSettings around_actions forward_actions straight_actions",
    "next_probe.decision_problem": "Actions Belief Decision DecisionProblem HandShape",
    "numerics.threads": "set_threads",
    "policies": "build_policy",
    "policies.steering": "Steering",
    "problem.mesh": "load_mesh",
    "problem.online_registration": "OnlineRegistration",
    "problem.points": "KnownPoints Workspace",
    "problem.registration_problem": "ArchiveSnapshot Hypotheses RegistrationProblem Trust",
    "problem.sdf_grid": "SdfGrid",
    "problem.trust": "trust_in",
    "sensing.free_space": "FreeGrid interior_lattice poses_between",
}
_PLACES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that `replay info` need not wait for torch."""
    if name == "__version__":
        from importlib.metadata import version

        return version("chsel-replay")
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
