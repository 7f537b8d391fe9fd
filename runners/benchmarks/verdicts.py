"""`python -m runners.benchmarks.verdicts`: the verdicts that results get on points with faults."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

import chsel
from chsel.methods import METHODS
from chsel.numerics.arrays import FloatArray
from chsel.problem.defaults import object_grid
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import VERDICTS
from replay.console import Console
from runners.objects.loader import MODELS, load_model

TRUTH = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.9)), np.array([0.3, 0.1, 0.2]))
AFTERWARDS = compose(
    axis_angle(np.array([0.0, 0.6, 0.8]), np.array(1.6)), np.array([0.34, 0.12, 0.2])
)  # where an object stands that has been pushed
_SPACING = 0.01  # of free points, metres
_AROUND = 0.06  # metres beyond the object
_CONTACTS = 60


FAULTS = (
    "none",
    "noise of 3 mm",
    "one contact in ten foreign",
    "3 contacts, no free points",
    "mesh 1.2 times too large",
    "mesh 1.2 times too small",
    "mesh of another object",
    "object moved halfway",
)
OTHERS = dict(zip(MODELS, [*list(MODELS)[1:], *list(MODELS)[:1]], strict=True))


class Case(NamedTuple):
    """Points in the world, and the grid of the object that they are taken for."""

    surface: FloatArray  # (M, 3), m
    free: FloatArray  # (N, 3), m
    target: chsel.SdfGrid


class Probed:
    """A model at its real size, and points as sensors would know them."""

    def __init__(self, name: str, seed: int) -> None:
        self._name, self._mesh = name, load_model(name)
        self._rng = np.random.default_rng(seed)
        self._far = chsel.SdfGrid.from_mesh(self._mesh, 0.008, padding=2.0 * _AROUND)
        self.target = object_grid(self._mesh)

    def contacts(self, pose: FloatArray, noise: float) -> FloatArray:
        """Points (60, 3) all around, off the surface by noise along its normals."""
        seed = int(self._rng.integers(2**31))
        points, faces = trimesh.sample.sample_surface(self._mesh, _CONTACTS, seed=seed)
        away = noise * self._rng.standard_normal((_CONTACTS, 1)) * self._mesh.face_normals[faces]
        return apply(pose, np.asarray(points + away))

    def free(self, pose: FloatArray) -> FloatArray:
        """The points (N, 3) of a lattice that are around the object."""
        corners = apply(pose, trimesh.bounds.corners(self._mesh.bounds))
        lower, upper = corners.min(axis=0) - _AROUND, corners.max(axis=0) + _AROUND
        shape = np.ceil((upper - lower) / _SPACING).astype(int)
        points = lower + _SPACING * np.indices(tuple(shape)).reshape(3, -1).T
        height, _ = self._far.at(apply(inverse(pose), points), lookup="trilinear")
        return points[height > 0.0]

    def case(self, fault: str) -> Case:
        """Points with one of FAULTS."""
        free, grid, mesh = self.free(TRUTH), self.target, self._mesh
        surface = self.contacts(TRUTH, 0.003 if fault == "noise of 3 mm" else 0.0005)
        if fault == "one contact in ten foreign":
            surface[: _CONTACTS // 10] += self._rng.uniform(-0.08, 0.08, (_CONTACTS // 10, 3))
        elif fault == "3 contacts, no free points":
            surface, free = surface[:3], free[:0]
        elif fault == "mesh 1.2 times too large":
            grid = object_grid(mesh.copy().apply_scale(1.2))
        elif fault == "mesh 1.2 times too small":
            grid = object_grid(mesh.copy().apply_scale(1.0 / 1.2))
        elif fault == "mesh of another object":
            grid = object_grid(load_model(OTHERS[self._name]))
        elif fault == "object moved halfway":
            surface[_CONTACTS // 2 :] = self.contacts(AFTERWARDS, 0.0005)[_CONTACTS // 2 :]
            free = np.concatenate([free, self.free(AFTERWARDS)])
        return Case(surface, free, grid)


def counted(
    objects: list[str], methods: list[str], faults: Sequence[str], show: Callable[[str], None]
) -> dict[tuple[str, str], Counter[str]]:
    """How often each verdict was given, by fault and method; show: gets what is being done."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for seed, name in enumerate(objects):
        probed = Probed(name, seed)
        for fault in faults:
            case = probed.case(fault)
            for method in methods:
                show(f"{name}, {fault}, {method}")
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", chsel.PointsWarning)  # they are what is counted
                    found = chsel.register(
                        case.target, surface=case.surface, free=case.free, method=method
                    )
                verdict = "none" if found.trust is None else found.trust.verdict
                counts.setdefault((fault, method), Counter())[verdict] += 1
    return counts


def table(counts: dict[tuple[str, str], Counter[str]]) -> list[str]:
    """The counts as the lines of a table of Markdown."""
    lines = ["| fault | method | " + " | ".join(VERDICTS) + " |", "|---|---|" + "--:|" * 4]
    for (fault, method), verdicts in counts.items():
        cells = " | ".join(str(verdicts[verdict] or "") for verdict in VERDICTS)
        lines.append(f"| {fault} | {method} | {cells} |")
    return lines


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="runners.benchmarks.verdicts", description=__doc__)
    parser.add_argument("--objects", nargs="+", choices=tuple(MODELS), default=list(MODELS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["chsel", "anchored"])
    given = parser.parse_args()
    console = Console()
    with console.status("making points") as status:
        counts = counted(given.objects, given.methods, FAULTS, status.update)
    for line in table(counts):
        console.print(line, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
