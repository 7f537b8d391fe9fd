"""LLVM may fuse, reorder or replace nothing, whatever the CPU that it makes machine code for."""

import importlib
import inspect
import re

import numpy as np
import pytest
import trimesh
from numba.core.registry import CPUDispatcher
from numba.core.types import BaseTuple, NamedTuple, NamedUniTuple

from chsel.numerics import compiler
from chsel.plausible.plausible_set import plausible_set
from chsel.plausible.plausible_settings import PlausibleSettings, PoseGridSettings
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from chsel.problem.trust import trust_in
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges
from chsel.sensing.free_space import FreeGrid
from tests.chsel.samples import REPOSITORY, hypotheses_at, kernel_files
from tests.determinism.cases import CASES
from tests.determinism.decisions import decision_stages
from tests.determinism.record import fused
from tests.determinism.stages import grid, run, scene

pytestmark = pytest.mark.slow  # compiles nearly all kernels
ENOUGH = ("chsel default", "contacts alone", "chsel reference", "plane_angle", "deep alpha")
ENOUGH += ("icp default", "svgd default", "SVGD, median", "cvo default", "cvo reference")
ENOUGH += ("anchored default", "anchored on a plane")
ENOUGH += ("medial_constraint default", "medial_constraint_cma_me default", "medial, one start")
# By IEEE 754, or not of numbers.
EXACT = {"sqrt", "sqrtf", "floor", "floorf", "rint", "rintf", "memset", "memcpy", "memmove"}

_DECLARED = re.compile(r"^declare [^@\n]*@([\w.]+)\(", re.MULTILINE)
_OF_LLVM = r"llvm\.(?!fma|exp(?!erimental\.noalias)|log|sin|cos|tan|pow|a(?:sin|cos|tan))"
_PYTHON = re.compile(rf"_?(?:Py|NRT_|numba_|{_OF_LLVM})")
_LOOSE = re.compile(r"\b(?:fast|reassoc|contract|arcp|afn|nsz)\b(?= )|llvm\.fmuladd|llvm\.fma\b")


def optimised(dispatcher):
    """The optimised LLVM code of each signature of a compiled function, callees included.

    Unlike numba's own way to inspect code, it also has code that was read from the cache.
    """
    results = dispatcher.overloads.values()
    return [str(result.library._get_module_for_linking()) for result in results]


def called(code):
    """The functions outside of it that LLVM code calls, but for those of Python and numba."""
    return {name for name in _DECLARED.findall(code) if not _PYTHON.match(name)}


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


@pytest.fixture(scope="module")
def code():
    """Optimised code, with that of their callees, of the kernels that Python calls."""
    for name in ENOUGH:
        run(CASES[name], grid(CASES[name].body))
    sdf = grid("bracket")
    first = np.eye(4)[None]
    decision_stages("bracket", sdf)
    points, workspace, resolution = scene("bracket", ("contacts", "free"))
    key = StreamKey(11, 0)
    depth = np.ones((3, 4))
    seen = np.ones((3, 4), dtype=bool)
    occlusion_edges(depth, seen, jump=0.1)
    space = FreeGrid(workspace, 0.05)
    space.from_depth(
        depth,
        PinholeCamera(4, 3, fx=5.0, fy=5.0, cx=2.0, cy=1.5),
        world_from_camera=first[0],
        mask=seen,
    )
    space.along_rays(np.zeros(3), np.ones((1, 3)))
    space.at(np.zeros((1, 3)))
    problem = RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=first,
        workspace=workspace,
        free_resolution=resolution,
        key=key,
    )
    trust_in(problem, hypotheses_at(first))
    poses = PoseGridSettings(rotations=5, upright=2)
    members = plausible_set(problem, first[0], settings=PlausibleSettings(epsilon=10.0, grid=poses))
    surface = surface_points(sdf, 4, stream=key.stream(Purpose.METRIC_POINTS))
    for method in ("grid", "exact"):
        settings = DistanceSettings(method=method)
        distance = SurfaceDistance(
            sdf, trimesh.creation.box((0.1,) * 3), points=surface, settings=settings
        )
        distance.between(first, members.world_from_object)
    return {name: optimised(kernel) for name, kernel in _from_python().items()}


def test_every_kernel_that_python_calls_is_looked_at(code):
    assert {"chsel.cost.objective.descend", "chsel.qd.emitters.me_iterations"} < set(code)
    assert [name for name, texts in code.items() if not texts] == []


def test_tuples_that_kernels_take_are_classes_of_files_that_the_kept_code_depends_on(code):
    kernels = _from_python().values()
    types = {each for kernel in kernels for signature in kernel.signatures for each in signature}
    classes = set()
    while types:
        each = types.pop()
        if isinstance(each, NamedTuple | NamedUniTuple):
            classes.add(each.instance_class)
        types |= set(each) if isinstance(each, BaseTuple) else set()
    files = {inspect.getsourcefile(each) for each in classes}
    assert len(classes) > 20
    assert files <= set(compiler._FILES.values())


def test_no_code_may_be_reordered_or_call_what_others_round_otherwise(code):
    for name, texts in code.items():
        for text in texts:
            assert _LOOSE.findall(text) == [], name
            assert called(text) <= EXACT, name


def test_what_may_be_fused_would_be_found():
    fused(np.ones(3))
    assert _LOOSE.findall(optimised(fused)[0])
