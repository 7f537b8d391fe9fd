"""What a case computes, stage by stage, so that the first stage that differs can be named."""

from functools import cache
from pathlib import Path

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import NullObserver
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import search_space
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd.emitters import SEARCHES
from chsel.qd.measures import MEASURES
from tests.chsel.samples import pose_problem

PROBLEMS_FILE = Path(__file__).with_name("problems.npz")
"""Grids of two bodies, and points around them: stored, so that no mesh, sine or BLAS matters."""


@cache
def _stored():
    with np.load(PROBLEMS_FILE) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


def grid(body):
    """A new grid of a body: "bracket" has flat faces, "mallet" is round."""
    names = ("origin", "resolution", "values", "gradients")
    origin, resolution, *arrays = (_stored()[f"grid/{body}/{name}"] for name in names)
    return SdfGrid(origin, float(resolution), *arrays)


def scene(place, classes):
    """Points, workspace and the side of free voxels of a place where the object of a grid is.

    place: "bracket" and "mallet" are tilted in space, "standing" is the bracket on a plane.
    classes: of points, "contacts", "free", "felt" (known SDF that is not 0), "occupied".
    """

    def points(name, of):
        array = _stored()[f"points/{place}/{name}"]
        return array if of in classes else array[:0]

    contacts, felt = points("contacts", "contacts"), points("felt", "felt")
    known_sdf = np.concatenate([np.zeros(len(contacts)), points("felt_sdf", "felt")])
    known = np.concatenate([contacts, felt])
    free, occupied = points("free", "free"), points("occupied", "occupied")
    lower, upper = _stored()[f"points/{place}/workspace"].tolist()
    resolution = float(_stored()[f"points/{place}/free_resolution"])
    return (
        KnownPoints(free, occupied, known=known, known_sdf=known_sdf),
        Workspace(lower, upper),
        resolution,
    )


class StageKeeper:
    """Keeps the state after every block of iterations as a stage."""

    def __init__(self, stages, case, step):
        self.snapshot_interval = 25 if case.long else 5
        self._stages, self._step = stages, step

    def progress(self, stage, iteration, total):
        """Nothing to keep."""

    def trace(self, stage, iteration, vectors, cost):
        """Vectors and costs; E_0's, and the archives of searches, are kept besides."""
        if stage not in SEARCHES and iteration > 0:
            self._keep(f"{stage} {iteration}", {"vectors": vectors.copy(), "costs": cost.copy()})

    def snapshot(self, archive):
        """The archive's range and cells."""
        self._keep(f"archive {archive.iteration}", archive_arrays(archive))

    def _keep(self, name, arrays):
        keep(self._stages, f"step {self._step}: {name}", arrays=arrays)


class Scribbler(NullObserver):
    """Watches every iteration, and writes over what it is shown."""

    snapshot_interval = 1

    def __init__(self, stages, case, step):
        pass

    def trace(self, stage, iteration, vectors, cost):
        vectors[:], cost[:] = np.nan, np.nan

    def snapshot(self, archive):
        for array in (archive.lower, archive.upper, archive.solutions, archive.measures):
            array[:] = np.nan


def nobody(stages, case, step):
    """No observer."""


def run(case, sdf, watch=StageKeeper):
    """All stages of a case; those within a registration as far as the observer keeps them."""
    method = case.build()
    stages = {}
    found = None
    where = scene(case.place, case.classes)
    for step in range(case.steps):
        problem = pose_problem(sdf, *where, StreamKey(11, step), method.online, found)
        if watch is StageKeeper:
            _keep_start(stages, method.settings, problem=problem, step=step)
        found = method.register(problem, watch(stages, case, step))
        if found.archive is not None:
            keep(stages, f"step {step}: last archive", arrays=archive_arrays(found.archive))
        names = ("object_from_world", "cost", "duplicate", "cell", "elites")
        keep(
            stages,
            f"step {step}: hypotheses",
            arrays={name: getattr(found, name) for name in names},
        )
    return stages


def _keep_start(stages, settings, *, problem, step):
    """E_0 and E_l, and what the kernels say about E_0."""

    def keep_as(name, **arrays):
        keep(stages, f"step {step}: {name}", arrays=arrays)

    keep_as("initial sets", E_0=problem.initial_set, E_l=problem.low_cost_set)
    keep_as("normal draws", draws=normals(problem.key.stream(Purpose.EMITTER), 3000))
    if not isinstance(getattr(settings, "cost", None), CostSettings):
        return  # the kernels of its cost show in its own stages
    space = search_space(settings.plane, problem.sdf)
    objective = Objective(CompiledCost.of(problem, settings.cost), space)
    vectors = space.encode(Poses.of(problem.initial_set))
    keep_as("search vectors of E_0", vectors=vectors)
    keep_as("costs of E_0", costs=objective.costs(vectors))
    keep_as("gradients at E_0", gradients=objective.costs_and_gradients(vectors)[1])
    if hasattr(settings, "archive"):
        measure = MEASURES[settings.archive.measure]
        mean, deviation = measure.moments(measure.values(objective.space, vectors))
        slopes = np.array([measure.gradients(objective.space, vector) for vector in vectors])
        keep_as("measures of E_0", mean=mean, deviation=deviation, gradients=slopes)


def archive_arrays(archive):
    """The numbers of a snapshot."""
    names = ("lower", "upper", "cells", "solutions", "objectives", "measures")
    return {name: getattr(archive, name).copy() for name in names}


def keep(stages, name, *, arrays):
    """Add a stage; one that comes again, in a later pass, is numbered."""
    unique, number = name, 1
    while unique in stages:
        number += 1
        unique = f"{name} (pass {number})"
    stages[unique] = arrays
