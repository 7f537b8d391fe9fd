"""No CPU fuses a product and a sum, as that would round once where another rounds twice."""

import importlib
import math
import platform
from pathlib import Path

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest
import trimesh
from numba.core.registry import CPUDispatcher

from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import _remainder
from chsel.plausible.plausible_set import plausible_set
from chsel.plausible.plausible_settings import PlausibleSettings, PoseGridSettings
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from chsel.problem.trust import trust_in
from chsel.qd.archive import GridArchive
from chsel.qd.measures import MEASURES
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges
from chsel.sensing.free_space import FreeGrid
from tests.chsel.samples import hypotheses_at, kernel_files
from tests.determinism.cases import CASES
from tests.determinism.decisions import decision_stages
from tests.determinism.libraries import fused as contracted
from tests.determinism.machine_code import assembly, called, fused, host, loose, optimised, target
from tests.determinism.problems import grid, scene
from tests.determinism.stages import run

pytestmark = pytest.mark.slow  # compiles nearly all kernels
REPOSITORY = Path(__file__).resolve().parents[2]
ENOUGH = ("chsel default", "contacts alone", "chsel reference", "plane_angle", "deep alpha")
ENOUGH += ("icp default", "svgd default", "SVGD, median", "cvo default", "cvo reference")
ENOUGH += ("anchored default", "anchored on a plane")
ENOUGH += ("medial_constraint default", "medial_constraint_cma_me default", "medial, one start")
EXACT = {
    "sqrt",
    "sqrtf",
    "floor",
    "floorf",
    "rint",
    "rintf",
    "memset",
    "memcpy",
    "memmove",
}  # by IEEE 754, or not of numbers
HASWELL = ("x86_64-unknown-linux-gnu", "haswell", "+avx2,+fma")
ARM = ("aarch64-unknown-linux-gnu", "generic", "")


def planted(x, y):
    """What compilers like to fuse."""
    return x * y + 1.0


@pytest.fixture(scope="module")
def code():
    """Optimised code, with that of their callees, of the kernels that Python calls."""
    for name in ENOUGH:
        run(CASES[name], grid(CASES[name].body))
    decision_stages("bracket", grid("bracket"))
    archive = GridArchive(MEASURES["position_2"], np.zeros(2), np.ones(2), bins=2, dimension=9)
    archive.cells_of(np.zeros((1, 2)))
    where = scene(grid("bracket"), "bracket", ("contacts", "free"))
    key, first = StreamKey(11, 0), np.eye(4)[None]
    space, camera = FreeGrid(where.workspace, 0.05), PinholeCamera(4, 3, 5.0, 5.0, 2.0, 1.5)
    depth, seen = np.ones((3, 4)), np.ones((3, 4), dtype=bool)
    occlusion_edges(depth, seen, 0.1)
    space.from_depth(depth, camera, first[0], seen)
    space.along_rays(np.zeros(3), np.ones((1, 3)))
    space.at(np.zeros((1, 3)))
    problem = RegistrationProblem(
        where.sdf, where.points, first, where.workspace, where.free_resolution, key
    )
    poses = PoseGridSettings(rotations=5, upright=2)
    members = plausible_set(problem, first[0], PlausibleSettings(epsilon=10.0, grid=poses))
    trust_in(problem, hypotheses_at(first))
    surface = surface_points(where.sdf, 4, key.stream(Purpose.METRIC_POINTS))
    for method in ("grid", "exact"):
        settings = DistanceSettings(method=method)
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        distance = SurfaceDistance(where.sdf, box, surface, settings)
        distance.between(first, members.world_from_object)
    return {
        f"{name} {i}": text
        for name, kernel in _from_python().items()
        for i, text in enumerate(optimised(kernel))
    }


def _from_python():
    """The kernels by full name that Python calls; elementary functions are in their callers."""
    found = {}
    for source in kernel_files():
        module = ".".join(source.relative_to(REPOSITORY).with_suffix("").parts)
        for name, kernel in vars(importlib.import_module(module)).items():
            own = isinstance(kernel, CPUDispatcher) and kernel.__module__ == module
            if not own or kernel.targetoptions.get("no_cpython_wrapper"):
                continue
            if module != "chsel.numerics.elementary" or name.startswith("_fill_"):
                found[f"{module}.{name}"] = kernel
    return found


def _on(name):
    """This CPU, or one of its kind that can fuse if it cannot itself; or an ARM."""
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    if name == "ARM":
        if not is_x86:
            pytest.skip(f"code of this {platform.machine()} cannot be made anew for another CPU")
        return target(*ARM)
    return target(*HASWELL) if is_x86 and not llvm.get_host_cpu_features().get("fma") else host()


def test_every_kernel_that_python_calls_is_looked_at(code):
    kernels = _from_python()
    assert {"chsel.cost.objective.descend", "chsel.qd.emitters.me_iterations"} < set(kernels)
    assert set(kernels) == {name.split()[0] for name in code}


@pytest.mark.parametrize("cpu", ["host", "ARM"])
def test_no_product_is_fused_with_a_sum(cpu, code):
    machine = _on(cpu)
    assert {name: fused(assembly(text, machine)) for name, text in code.items()} == {
        name: [] for name in code
    }


def test_no_code_may_be_reordered(code):
    assert {name: loose(text) for name, text in code.items()} == {name: [] for name in code}


def test_no_kernel_calls_the_c_library_for_what_it_rounds_its_own_way(code):
    assert set().union(*map(called, code.values())) <= EXACT


@pytest.mark.parametrize("cpu", ["host", "ARM"])
def test_a_fused_product_would_be_found(cpu):
    loosely = numba.njit("float64(float64, float64)", fastmath={"contract"})(planted)
    strictly = numba.njit("float64(float64, float64)")(planted)
    contracted(np.ones(3))
    machine = _on(cpu)
    for function in (loosely, contracted):
        (text,) = optimised(function)
        assert loose(text)
        assert fused(assembly(text, machine))
    (text,) = optimised(strictly)
    assert not loose(text)
    assert not fused(assembly(text, machine))


def test_a_call_of_the_c_library_would_be_found():
    @numba.njit("float64(float64)")
    def inexact(x):
        return math.exp(x) + math.sin(x)

    (text,) = optimised(inexact)
    names = called(text)
    assert any("exp" in name for name in names)
    assert any("sin" in name for name in names)


def test_code_from_the_cache_is_seen_as_freshly_compiled_code_is():
    function = _remainder.py_func
    fresh = numba.njit(nogil=True, error_model="numpy")(function)
    compiled(function)(10.0)
    cached = compiled(function)
    assert fresh(10.0) == cached(10.0) == 10.0 - 2.0 * math.pi
    assert cached.stats.cache_hits
    assert not fresh.stats.cache_hits
    products = [assembly(*optimised(made), host()).count("mul") for made in (fresh, cached)]
    assert products[0] == products[1] > 0
