"""Measures one checkout on request: the process of one side of `runners.benchmark against=REF`.

A program of its own, which imports the package that PYTHONPATH names: what it calls must be there
in other versions, too. It writes where the package is, then reads requests and writes answers, one
JSON object a line.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

import chsel
from chsel.problem.registration_problem import NullObserver
from chsel.problem.streams import StreamKey

_FINGER = (0.008, 0.008, 0.06)  # sides of the hand that probes along z, metres
_ADDITIONS = 10  # calls of Session.add in one measurement


class Clocks:
    """Seconds of named parts, by processor and by the clock on the wall."""

    def __init__(self) -> None:
        self._parts: dict[str, list[tuple[float, float]]] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measure a block, which may run many times."""
        processor, wall = time.process_time(), time.perf_counter()
        yield
        taken = time.process_time() - processor, time.perf_counter() - wall
        self._parts.setdefault(name, []).append(taken)

    def quantile(self, q: float = 0.5) -> dict[str, dict[str, float]]:
        """Return a quantile of the seconds of each part, by default the median."""
        found = {name: np.quantile(times, q, axis=0) for name, times in self._parts.items()}
        return {name: {"processor": float(p), "wall": float(w)} for name, (p, w) in found.items()}


class StageClock(NullObserver):
    """An observer of registrations that takes the processor time of their stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._mark = time.process_time()

    def progress(self, stage: str, iteration: int, total: int) -> None:  # noqa: PLR0917
        """Count the time since the last report for the stage."""
        now = time.process_time()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now


class Robot:
    """A hand that moves straight ahead until it touches the object of a scene."""

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: np.ndarray) -> None:
        self._scene = mesh.copy().apply_transform(world_from_object)

    def touch(self, start: np.ndarray, length: float) -> tuple[list[np.ndarray], Any]:
        """Return the hand's path (2, 4, 4), and the contact (3,), None if there is none."""
        ahead = start[:3, 2]
        tip = start[:3, 3] + 0.5 * _FINGER[2] * ahead
        hits = self._scene.ray.intersects_location([tip], [ahead])[0]
        way = min([length, *((hits - tip) @ ahead)])
        end = start.copy()
        end[:3, 3] += way * ahead
        return [start, end], tip + way * ahead if way < length else None


class Worker:
    """The tasks, each with the seconds of its parts as its answer."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._problems: dict[str, Any] = {}

    def register(self, problem: str, method: str, *, settings: dict[str, Any]) -> dict[str, Any]:
        """Register a problem of a file, with settings other than the default ones."""
        posed = self._problem(problem)
        clocks = Clocks()
        with clocks.part(""):
            chosen = replace(chsel.build_method(method).settings, **settings)
            found = chsel.build_method(method, chosen).register(_fresh(posed))
        return {"parts": clocks.quantile(), "poses": found.object_from_world.tolist()}

    def stages(self, problem: str) -> dict[str, Any]:
        """Register by `anchored` with an observer."""
        posed = self._problem(problem)
        stages = StageClock()
        begun = time.process_time()
        chsel.build_method("anchored").register(_fresh(posed), stages)
        other = time.process_time() - begun - sum(stages.seconds.values())
        seconds = {**stages.seconds, "other": other}
        return {"parts": {name: {"processor": taken} for name, taken in seconds.items()}}

    def steer(self, mesh: str, steps: int, *, recorded: bool) -> dict[str, Any]:
        """Steer a session as examples/own_robot.py does: medians of its steps, and their 95 %."""
        target = chsel.load_mesh(mesh)
        truth = trimesh.transformations.rotation_matrix(0.7, [0, 0, 1])
        truth[:3, 3] = 0.45, 0.1, 0.0
        robot = Robot(target, truth)
        hand = trimesh.creation.box(_FINGER)
        table = chsel.Workspace((0.35, 0.0, 0.0), (0.55, 0.2, 0.2))
        clocks = Clocks()
        with tempfile.TemporaryDirectory() as folder:
            record = Path(folder) / "session.mcap" if recorded else None
            with chsel.Session(target, hand=hand, workspace=table, record=record) as session:
                probe = session.next_probe()
                while probe is not None and session.step + 1 < steps:
                    path, contact = robot.touch(probe.world_from_hand, probe.length)
                    with clocks.part(""):
                        with clocks.part("add"):
                            session.add(hand=hand, path=path, contact=contact)
                        with clocks.part("register"):
                            session.register()
                        with clocks.part("belief"):
                            _ = session.belief if session.trust is not None else None
                        with clocks.part("decide"):
                            probe = session.next_probe()
        middle = clocks.quantile()
        names = ("add", "register", "belief", "decide") if recorded else ()
        parts = {"": middle[""], "95 %": clocks.quantile(0.95)[""]}
        return {"parts": parts | {name: middle[name] for name in names}}

    def add(self, mesh: str, known: int) -> dict[str, Any]:
        """Add a contact and 300 free points to a session that knows so many free points."""
        target = chsel.load_mesh(mesh)
        generator = np.random.default_rng(0)
        contacts = generator.permutation(target.vertices)
        lattice = 0.01 * np.indices((60, 60, 60)).reshape(3, -1).T - 0.29
        lower, upper = target.bounds
        outside = (np.clip(lattice, lower - 0.01, upper + 0.01) != lattice).any(axis=1)
        free = generator.permutation(lattice[outside])
        session = chsel.Session(target, workspace=chsel.Workspace((-0.3,) * 3, (0.3,) * 3))
        session.add(free=free[:known], contacts=contacts[:20])
        clocks = Clocks()
        for index in range(_ADDITIONS):
            new = free[known + 300 * index : known + 300 * (index + 1)]
            with clocks.part(""):
                session.add(free=new, contacts=contacts[20 + index : 21 + index])
        if len(session.points.free) != known + 300 * _ADDITIONS:
            raise RuntimeError(f"the session knows {len(session.points.free)} free points")
        return {"parts": clocks.quantile()}

    def plate(self, sides: list[float]) -> dict[str, Any]:
        """Make the grid of a plate, register it once, and read the memory of this process."""
        mesh = trimesh.creation.box(sides)
        generator = np.random.default_rng(0)
        contacts = generator.uniform(-0.5, 0.5, (20, 3)) * sides
        contacts[:, 2] = 0.5 * sides[2]
        free = generator.uniform(-0.2, 0.2, (300, 3))
        free = free[np.abs(free[:, 2]) > 0.01]
        clocks = Clocks()
        with clocks.part("grid"):
            chsel.SdfGrid.from_mesh(mesh)
        with clocks.part("first registration"):
            chsel.register(mesh, contacts=contacts, free=free)
        return {"parts": {**clocks.quantile(), "peak memory": {"bytes": _peak_memory()}}}

    def _problem(self, path: str) -> Any:
        """Return the problem of a file, read once."""
        if path not in self._problems:
            with np.load(path) as arrays:
                data = dict(arrays)
            mesh = trimesh.Trimesh(data["vertices"], data["faces"], process=False)
            self._problems[path] = chsel.RegistrationProblem(
                sdf=chsel.SdfGrid.from_mesh(mesh, float(data["sdf_resolution"])),
                points=chsel.KnownPoints(free=data["free"], known=data["contacts"]),
                initial_set=data["initial_set"],
                workspace=chsel.Workspace(tuple(data["lower"]), tuple(data["upper"])),
                free_resolution=float(data["free_spacing"]),
                key=StreamKey(0, 0),
            )
        return self._problems[path]


def _fresh(problem: Any) -> Any:
    """Return the problem with nothing computed from its points yet."""
    return replace(problem, points=replace(problem.points))


def _peak_memory() -> float:
    """Return the largest memory of this process, bytes; not that of the one that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM:"))
    return 1024.0 * int(line.split()[1])


def main() -> None:
    """Answer requests until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what packages print is not an answer
    warnings.simplefilter("ignore")  # about made-up points

    def answer(values: dict[str, Any]) -> None:
        answers.write(json.dumps(values) + "\n")
        answers.flush()

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(sys.argv[1])})
    worker = Worker()
    answer({"chsel": str(Path(str(chsel.__file__)).parent)})
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer(getattr(worker, request.pop("task"))(**request))
        except Exception as error:
            answer({"error": f"{type(error).__name__}: {error}"})


if __name__ == "__main__":
    main()
