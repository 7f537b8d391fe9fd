"""CHSEL: the set of plausible poses of an object, from contacts and free space.

Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from Contact and
Free Space Data", Robotics: Science and Systems, 2023.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if os.path.exists(os.path.join(os.path.dirname(__file__), "wrapper.py")):  # a file of theirs
    raise ImportError(
        f"the package chsel in {os.path.dirname(__file__)} is not this project's, or has files of "
        "PyPI's chsel among its own, as both have one name; to mend it: pip uninstall -y chsel "
        "chsel-replay, and install this project again, in an environment of its own"
    )

if TYPE_CHECKING:
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
    from chsel.next_probe.decision_problem import Actions, Belief, Decision, DecisionProblem
    from chsel.next_probe.hand_shape import HandShape
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
    from chsel.sensing.free_space import FreeGrid
    from chsel.sensing.swept import interior_lattice, poses_between

    __version__: str

__all__ = [
    "ActionSettings",
    "Actions",
    "ArchiveSnapshot",
    "Belief",
    "ChselError",
    "CompiledCost",
    "CostSettings",
    "Decision",
    "DecisionProblem",
    "FreeGrid",
    "HandShape",
    "Hypotheses",
    "InputWarning",
    "KnownPoints",
    "MeshWarning",
    "OnlineRegistration",
    "PointsWarning",
    "RegistrationProblem",
    "RelaxedCost",
    "SdfGrid",
    "Steering",
    "Trust",
    "Workspace",
    "around_actions",
    "build_method",
    "build_policy",
    "forward_actions",
    "interior_lattice",
    "load_mesh",
    "poses_between",
    "register",
    "set_threads",
    "straight_actions",
    "trust_in",
]

_PLACES = {
    "ActionSettings": "next_probe.action_lattice",
    "Actions": "next_probe.decision_problem",
    "ArchiveSnapshot": "problem.registration_problem",
    "Belief": "next_probe.decision_problem",
    "ChselError": "errors",
    "CompiledCost": "cost.compiled_cost",
    "CostSettings": "cost.cost_settings",
    "Decision": "next_probe.decision_problem",
    "DecisionProblem": "next_probe.decision_problem",
    "FreeGrid": "sensing.free_space",
    "HandShape": "next_probe.hand_shape",
    "Hypotheses": "problem.registration_problem",
    "InputWarning": "errors",
    "KnownPoints": "problem.points",
    "MeshWarning": "errors",
    "OnlineRegistration": "problem.online_registration",
    "PointsWarning": "errors",
    "RegistrationProblem": "problem.registration_problem",
    "RelaxedCost": "cost.torch_cost",
    "SdfGrid": "problem.sdf_grid",
    "Steering": "policies.steering",
    "Trust": "problem.registration_problem",
    "Workspace": "problem.points",
    "around_actions": "next_probe.action_lattice",
    "build_method": "methods",
    "build_policy": "policies",
    "forward_actions": "next_probe.action_lattice",
    "interior_lattice": "sensing.swept",
    "load_mesh": "problem.mesh",
    "poses_between": "sensing.swept",
    "register": "api",
    "set_threads": "numerics.threads",
    "straight_actions": "next_probe.action_lattice",
    "trust_in": "problem.trust",
}


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
