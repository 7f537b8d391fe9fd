"""The measurements that two checkouts are compared by."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import in_preset
from runners.benchmarks.checkouts import (
    RATE,
    ROOT,
    Answer,
    ComparedRow,
    Comparison,
    Side,
    asked,
    ran,
)
from runners.benchmarks.registrations import PROBLEMS, drill, pose

_MODELS = ROOT / "runners" / "objects" / "models"
_STEPS = 12  # of a steered session
_PLATE = (0.2, 0.12, 0.0006)  # metres
_SIMULATED = find_spec("pybullet") is not None
_PROBE = (  # what `make probe` runs
    "-m",
    "runners.probe",
    "object=drill",
    "method=chsel",
    f"session={'simulated' if _SIMULATED else 'kinematic'}",
)
_EVALUATE = (  # a cut of the experiment
    "-m",
    "runners.evaluate",
    "experiment=sparse",
    "configurations=mustard",
    "seeds=30",
    "faults=[clean,noise_1mm]",
    "workers=2",
)
_COPIED = ("chsel", "replay", "runners", "conf", "tests", "pyproject.toml")
_EDITED = {  # files of kernels, and their tests
    "chsel/methods/icp.py": "tests/chsel/methods/test_icp.py",
    "chsel/methods/anchored/energy.py": "tests/chsel/methods/test_anchored_energy.py",
}


def _registrations(
    comparison: Comparison, cases: Sequence[tuple[str, str, dict[str, Any]]]
) -> Iterator[ComparedRow]:
    """Yield registrations of problems by methods with settings."""
    for name, method, settings in cases:
        file = _problem_file(comparison, name)
        cost = RelaxedCost.of(_problem(name), in_preset(CostSettings(), "paper"))
        yield from comparison.rows(
            ", ".join([method, *settings.values(), name]),
            partial(asked, task="register", problem=file, method=method, settings=settings),
            cost=partial(_least, cost),
        )


def _least(cost: RelaxedCost, poses: Any) -> float:
    return float(cost.evaluate(np.array(poses)).min())


def anchored(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield `anchored` in two sizes on three problems."""
    sizes = ({"size": "adaptive"}, {"size": "medium"})
    names = ("real_20", "real_150", "large_20")
    cases = [(name, "anchored", size) for size in sizes for name in names]
    yield from _registrations(comparison, cases)


def methods(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield other methods as they ship."""
    cases = [("real_20", "chsel"), ("large_150", "chsel")]
    cases += [("real_20", "cvo"), ("real_20", "medial_constraint")]
    yield from _registrations(comparison, [(name, method, {}) for name, method in cases])


def stages(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield the stages of `anchored`, adaptive."""
    problem = _problem_file(comparison, "real_20")
    measure = partial(asked, task="stages", problem=problem)
    yield from comparison.rows("stage of anchored, real_20", measure)


def session(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield steps of the steered session of examples/own_robot.py: medians, 95 %, and parts."""
    for recorded, case in ((True, "step of a session"), (False, "step, not recorded")):
        mesh = f"{_MODELS}/mustard.ply"
        measure = partial(asked, task="steer", mesh=mesh, steps=_STEPS, recorded=recorded)
        yield from comparison.rows(case, measure)


def add(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield `Session.add` of a contact and 300 free points at two sizes."""
    for known in (3_000, 115_000):
        measure = partial(asked, task="add", mesh=f"{_MODELS}/drill.ply", known=known)
        yield from comparison.rows(f"Session.add at {known} free points", measure)


def startup(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield imports, and the help of a command, with the start of Python."""
    for line in ("import chsel", "from chsel import Session"):
        yield from comparison.rows(line, partial(ran, command=("-c", line)))
    command = ("-m", "runners.probe", "--help")
    yield from comparison.rows("runners.probe --help", partial(ran, command=command))


def verify(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield `replay verify` of the drill's session, recorded by the code of each side."""

    def once(side: Side) -> Answer:
        found = sorted(side.scratch.glob("probe/*/recording.mcap"))
        if not found:
            side.run((*_PROBE, "recording=mcap", f"logs={side.scratch}"))
            found = sorted(side.scratch.glob("probe/*/recording.mcap"))
        return ran(side, ("-m", "replay", "verify", str(found[0])))

    yield from comparison.rows("replay verify, drill", once, unit="s")


def evaluation(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield registrations a minute of a cut of `experiment=sparse` by two workers."""

    def once(side: Side) -> Answer:
        with tempfile.TemporaryDirectory(dir=side.scratch) as out:
            taken = side.run((*_EVALUATE, f"out={out}"))
            count = len((Path(out) / "results.csv").read_text().splitlines()) - 1
        processor = {"processor": taken["processor"] / count}
        return Answer({"": {"wall": taken["wall"] / count}, "a registration": processor})

    yield from comparison.rows(
        "experiment=sparse, two workers", once, unit=RATE, clock="wall", seldom=True, warm=False
    )


def plate(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield the first registration of a thin plate, its grid and peak memory, in new processes."""

    def once(side: Side) -> Answer:
        with side.start() as worker:
            return Answer(worker.ask("plate", sides=_PLATE)["parts"])

    yield from comparison.rows("plate", once, unit="s", seldom=True)


def first_probe(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield the session of `make probe` with no kernel compiled yet, and what compiling takes."""

    def once(side: Side) -> Answer:
        with tempfile.TemporaryDirectory(dir=side.scratch) as folder:
            command = (*_PROBE, f"logs={folder}")
            first = side.run(command, variables={"CHSEL_CACHE_DIR": f"{folder}/kernels"})
            second = side.run(command, variables={"CHSEL_CACHE_DIR": f"{folder}/kernels"})
        compiling = {clock: first[clock] - second[clock] for clock in first}
        return Answer({"all": first, "compiling": compiling})

    yield from comparison.rows("first probe", once, unit="s", seldom=True, warm=False)


def edit(comparison: Comparison) -> Iterator[ComparedRow]:
    """Yield tests of files with kernels, which were edited: with compiling what depends on them."""

    def once(side: Side, *, file: str, test: str) -> Answer:
        copy = side.scratch / "edited"
        if not copy.exists():
            copy.mkdir()
            for name in _COPIED:
                place = shutil.copytree if (side.folder / name).is_dir() else shutil.copy
                place(side.folder / name, copy / name)
        with (copy / file).open("a") as source:
            source.write("# edited\n")
        variables = {"PYTHONPATH": str(copy), "CHSEL_CACHE_DIR": str(side.scratch / "kernels")}
        command = ("-m", "pytest", "-q", "-p", "no:cacheprovider", test)
        return Answer({"": side.run(command, folder=copy, variables=variables)})

    for file, test in _EDITED.items():
        measure = partial(once, file=file, test=test)
        yield from comparison.rows(f"{test} after an edit", measure, unit="s", seldom=True)


@cache
def _problem(name: str) -> RegistrationProblem:
    return pose(PROBLEMS[name], seed=0)


def _problem_file(comparison: Comparison, name: str) -> str:
    """Write one of PROBLEMS for the processes, and return its path."""
    path = comparison.scratch / f"{name}.npz"
    if not path.exists():
        problem = _problem(name)
        mesh = drill(PROBLEMS[name].scale)[0]
        np.savez(
            path,
            vertices=mesh.vertices,
            faces=mesh.faces,
            sdf_resolution=problem.sdf.resolution,
            free=problem.points.free,
            free_spacing=problem.free_resolution,
            contacts=problem.points.contacts,
            initial_set=problem.initial_set,
            lower=problem.workspace.lower,
            upper=problem.workspace.upper,
        )
    return str(path)


GROUPS: dict[str, Callable[[Comparison], Iterator[ComparedRow]]] = {
    "anchored": anchored,
    "methods": methods,
    "stages": stages,
    "session": session,
    "add": add,
    "startup": startup,
    "verify": verify,
    "evaluation": evaluation,
    "plate": plate,
    "first_probe": first_probe,
    "edit": edit,
}
"""Rows of a comparison, by name."""
