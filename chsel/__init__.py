"""CHSEL: the set of plausible poses of an object, from contacts and free space.

Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from Contact and
Free Space Data", Robotics: Science and Systems, 2023.
"""

from chsel.api import register
from chsel.cost import RelaxedCost
from chsel.cost_settings import CostSettings
from chsel.engine import CompiledCost
from chsel.errors import ChselError
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
    "KnownPoints",
    "RegistrationProblem",
    "RelaxedCost",
    "SdfGrid",
    "Workspace",
    "load_mesh",
    "register",
]
