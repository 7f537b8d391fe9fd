# What the package offers: read by type checkers and editors, and by the package itself.

from .api import register as register
from .belief import Gripper as Gripper
from .belief import PoseBelief as PoseBelief
from .cost.compiled_cost import CompiledCost as CompiledCost
from .cost.cost_settings import CostSettings as CostSettings
from .cost.torch_cost import RelaxedCost as RelaxedCost
from .errors import ChselError as ChselError
from .errors import InputWarning as InputWarning
from .errors import MeshWarning as MeshWarning
from .errors import PointsWarning as PointsWarning
from .events import Probe as Probe
from .methods import build_method as build_method
from .next_probe.action_lattice import ActionSettings as ActionSettings
from .next_probe.action_lattice import around_actions as around_actions
from .next_probe.action_lattice import forward_actions as forward_actions
from .next_probe.action_lattice import straight_actions as straight_actions
from .next_probe.decision_problem import Actions as Actions
from .next_probe.decision_problem import Decision as Decision
from .next_probe.decision_problem import DecisionProblem as DecisionProblem
from .next_probe.decision_problem import HandShape as HandShape
from .next_probe.decision_problem import WeightedPoses as WeightedPoses
from .numerics.threads import set_threads as set_threads
from .policies import build_policy as build_policy
from .problem.mesh import load_mesh as load_mesh
from .problem.points import KnownPoints as KnownPoints
from .problem.points import Workspace as Workspace
from .problem.pose_prior import PosePrior as PosePrior
from .problem.pushes import Pushes as Pushes
from .problem.registration_problem import ArchiveSnapshot as ArchiveSnapshot
from .problem.registration_problem import Hypotheses as Hypotheses
from .problem.registration_problem import RegistrationProblem as RegistrationProblem
from .problem.registration_problem import Trust as Trust
from .problem.sdf_grid import SdfGrid as SdfGrid
from .problem.trust import trust_in as trust_in
from .sensing.depth_camera import PinholeCamera as PinholeCamera
from .sensing.free_space import FreeGrid as FreeGrid
from .sensing.free_space import interior_lattice as interior_lattice
from .sensing.free_space import poses_between as poses_between
from .session.judging import trust_by as trust_by
from .session.loop import Loop as Loop
from .session.session import NextProbe as NextProbe
from .session.session import Session as Session
from .which_object import Candidate as Candidate
from .which_object import WhichObject as WhichObject

__version__: str
