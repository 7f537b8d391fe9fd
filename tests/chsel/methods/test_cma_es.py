"""CMA-ES on functions whose minimum is known, beside figures of the cma package."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from chsel.methods import medial_constraint
from chsel.methods.medial_constraint import (
    CmaEsSettings,
    evolved,
    run_all,
)
from chsel.problem.registration_problem import NullObserver
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import Watcher

SPHERE, ELLIPSOID, ROSENBROCK, FLAT, NOT_FINITE = range(5)
D = 9
UNENDING = CmaEsSettings(population=10, sigma0=0.5, tolfun=0.0)


class Landscape(NamedTuple):
    kind: int


@numba.njit
def cost_of(model, space, vector, work):
    total, size = 0.0, len(vector)
    if model.kind == ROSENBROCK:
        for j in range(size - 1):
            total += 100.0 * (vector[j + 1] - vector[j] ** 2) ** 2 + (1.0 - vector[j]) ** 2
        return total
    for j in range(size):
        scale = 10.0 ** (6.0 * j / (size - 1)) if model.kind == ELLIPSOID else 1.0
        total += scale * vector[j] ** 2
    if model.kind == FLAT:
        return 4.0
    return np.inf if model.kind == NOT_FINITE else total


@numba.njit
def costs_of(model, space, vectors, costs, work):
    for n in range(len(vectors)):
        costs[n] = cost_of(model, space, vectors[n], work)


@pytest.fixture(autouse=True, scope="module")
def _on_landscapes():
    """Compiles the runs, as they are, around other functions instead of the cost."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(medial_constraint, "costs_of", costs_of)
        loop: Any = medial_constraint.evolve
        patch.setattr(medial_constraint, "evolve", numba.njit(error_model="numpy")(loop.py_func))
        yield


def objective(kind):
    """What the runs ask of an objective."""
    landscape = Landscape(kind)

    def costs(vectors):
        return np.array([cost_of(landscape, 0, vector, 0) for vector in vectors])

    space = SimpleNamespace(encode=lambda starts: starts)
    return SimpleNamespace(
        model=landscape, space_arrays=0, space=space, costs=costs, work=lambda: 0
    )


def runs_on(kind, settings, *, starts, observer=None):
    key = StreamKey(0, 0)
    observer = observer or NullObserver()
    return run_all(objective(kind), starts, settings=settings, key=key, observer=observer)


# Median evaluations of cma 4.5.0 over 21 seeds, population 10 and positive weights, until a cost
# of 1e-9; all of its runs got there.
@pytest.mark.parametrize(
    ("kind", "start", "sigma0", "theirs"),
    [(SPHERE, 1.0, 0.5, 1320), (ELLIPSOID, 1.0, 0.5, 4800), (ROSENBROCK, 0.0, 0.1, 4930)],
)
def test_it_needs_about_as_many_evaluations_as_the_cma_package(
    kind, start, sigma0, theirs, monkeypatch
):
    monkeypatch.setattr(medial_constraint, "_BLOCK", 1)  # traces every generation
    settings = replace(UNENDING, sigma0=sigma0, generations=900)
    watcher = Watcher()
    runs = runs_on(kind, settings, starts=np.full((21, D), start), observer=watcher)
    assert all(run.cost[0] <= 1e-9 for run in runs)
    reached = np.array([trace.cost <= 1e-9 for trace in watcher.traces])  # (generations, runs)
    evaluations = 10 * np.argmax(reached, axis=0)
    assert 0.8 * theirs < np.median(evaluations) < 1.25 * theirs


def test_the_best_is_the_lowest_cost_met_and_the_start_counts():
    lowest = []
    for generations in range(1, 31):
        (run,) = runs_on(SPHERE, replace(UNENDING, generations=generations), starts=np.ones((1, D)))
        lowest.append(run.batch.objectives.min())
        assert run.cost[0] == min(lowest)
    assert run.cost[0] == cost_of(Landscape(SPHERE), 0, run.best, 0)
    (run,) = runs_on(SPHERE, replace(UNENDING, generations=3), starts=np.zeros((1, D)))
    np.testing.assert_array_equal(run.best, 0.0)
    assert run.cost[0] == 0.0


def test_every_start_draws_from_a_stream_of_its_own():
    settings = replace(UNENDING, generations=120)
    starts = np.tile(np.ones(D), (3, 1))
    three = runs_on(SPHERE, settings, starts=starts)
    alone = runs_on(SPHERE, settings, starts=starts[:1])
    np.testing.assert_array_equal(three[0].best, alone[0].best)
    assert len({tuple(run.best) for run in three}) == 3


def ended_at(kind, **changes):
    (run,) = runs_on(kind, replace(UNENDING, **changes), starts=np.ones((1, D)))
    return int(run.generations[0]), run


def test_tolfun_ends_a_run_when_no_cost_of_a_generation_is_far_above_the_lowest():
    def spread(run):
        return float(run.batch.objectives.max() - run.cost[0])

    count, run = ended_at(SPHERE, tolfun=1e-5)
    assert run.ended[0]
    assert spread(run) <= 1e-5
    _, before = ended_at(SPHERE, tolfun=1e-5, generations=count - 1)
    assert not before.ended[0]
    assert spread(before) > 1e-5
    later, _ = ended_at(SPHERE, tolfun=1e-7)
    assert later > count


def test_generations_end_a_run_and_none_at_all_leaves_the_start():
    assert ended_at(ROSENBROCK, generations=17)[0] == 17
    (run,) = runs_on(SPHERE, replace(UNENDING, generations=0), starts=np.ones((1, D)))
    np.testing.assert_array_equal(run.best, 1.0)


@pytest.mark.parametrize("kind", [FLAT, NOT_FINITE])
def test_costs_that_are_all_the_same_end_a_run_at_once_at_its_start(kind):
    count, run = ended_at(kind)
    assert count == 1
    np.testing.assert_array_equal(run.best, 1.0)


def test_populations_and_generations_are_those_of_pycma():
    assert CmaEsSettings().size(9, 30) == 10
    assert CmaEsSettings().size(3, 30) == 7
    single = CmaEsSettings(starts="single")
    assert (single.size(9, 30), single.size(9, 1)) == (30, 10)
    assert single.most_generations(9, 30) == 4043


def test_a_single_run_gives_samples_of_its_last_distribution():
    settings = CmaEsSettings(starts="single", tolfun=1e-5)
    starts = np.concatenate([np.ones((1, D)), np.full((29, D), 50.0)])
    found = evolved(
        objective(SPHERE), starts, settings=settings, key=StreamKey(0, 0), observer=NullObserver()
    )
    assert found.shape == (30, D)
    assert len(np.unique(found, axis=0)) == 30
    assert (np.abs(found) < 0.05).all()
