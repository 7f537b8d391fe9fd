"""The compiled searches around landscapes that bring them to every turn."""

from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from chsel.numerics.arrays import digest
from chsel.numerics.pose_tuples import SpaceConstants
from chsel.problem.streams import StreamKey
from chsel.qd import emitters
from chsel.qd.archive import GridArchive
from chsel.qd.emitters import (
    SEARCHES,
    EmitterSettings,
    MegaSearch,
    fill_archive,
    me_search,
    mega_search,
)
from chsel.qd.measures import VECTOR, Measure, MeasureCode
from tests.chsel.methods.scene import Watcher

QUADRATIC, FLAT, NAN, INFINITE, NAN_BEYOND = range(5)
PLANAR = SpaceConstants(planar=True)  # whose vectors have four numbers
MEASURE = Measure(("x", "y"), MeasureCode(VECTOR, 2))
START = np.array([0.3, -0.2, 0.1, 0.2])
ITERATIONS, COUNT = 60, 12
SETTINGS = EmitterSettings(iterations=ITERATIONS, sigma0=0.2, rate=0.05)


class Landscape(NamedTuple):
    """A cost of 4-D vectors, of which the first two entries are the measures."""

    kind: int

    def costs(self, vectors):
        return np.array([cost_of(self, 0, vector, 0) for vector in vectors])


class LandscapeObjective:
    """What the searches ask for in place of chsel.cost.objective.Objective."""

    def __init__(self, kind):
        self.model = Landscape(kind)
        self.space_arrays = PLANAR

    def work(self):
        return 0


@numba.njit
def cost_of(model, space, vector, work):
    total = 0.0
    for j in range(4):
        if not np.isfinite(vector[j]):
            raise ValueError("a vector that is not finite was evaluated")
        total += (j + 1.0) * vector[j] * vector[j]
    if model.kind == FLAT:
        return 1.0
    if model.kind == NAN or (model.kind == NAN_BEYOND and abs(vector[3]) > 0.25):
        return np.nan
    return -np.inf if model.kind == INFINITE else total


@numba.njit
def cost_and_gradient_of(model, space, vector, gradient, work):
    for j in range(4):
        gradient[j] = 0.0 if model.kind == FLAT else 2.0 * (j + 1.0) * vector[j]
    return cost_of(model, space, vector, work)


@pytest.fixture(scope="module", autouse=True)
def searches_of_a_landscape(searches_around):
    searches_around(cost_of, cost_and_gradient_of)


def empty_archive():
    return GridArchive(MEASURE, np.full(2, -0.5), upper=np.full(2, 0.5), bins=8, dimension=4)


def found(name, kind, *, interval=0):
    """The archive after a search."""
    archive = empty_archive()
    objective: Any = LandscapeObjective(kind)
    observer = Watcher(snapshot_interval=interval)
    fill_archive(
        name,
        objective,
        archive=archive,
        start=START,
        count=COUNT,
        settings=SETTINGS,
        key=StreamKey(4, 0),
        observer=observer,
    )
    shown = [*range(0, ITERATIONS, interval or ITERATIONS), ITERATIONS]
    assert [snapshot.iteration for snapshot in observer.archives] == shown
    return archive


class Stepper:
    """One search, iteration by iteration, on one landscape after another."""

    def __init__(self, name):
        self.archive = empty_archive()
        self.iteration = 0
        self.search: Any = (
            mega_search(START, 2, batch=COUNT, settings=SETTINGS)
            if name == "cma_mega"
            else me_search(START, 2, batch=COUNT, settings=SETTINGS)
        )
        loops = {"cma_mega": emitters.mega_iterations, "cma_me": emitters.me_iterations}
        self._loop = loops[name]
        random = np.random.default_rng(0)
        n = len(self.search.strategy.mean)
        self._normals = random.standard_normal((ITERATIONS, COUNT, n))
        self.elites = random.random(ITERATIONS)

    def step(self, kind):
        landscape = emitters.Landscape(Landscape(kind), PLANAR, measure=MEASURE.code, work=0)
        self._loop(
            landscape,
            self.archive.cells,
            search=self.search,
            normals=self._normals,
            elites=self.elites,
            first=self.iteration,
            last=self.iteration + 1,
        )
        self.iteration += 1


def bytes_of(archive):
    return digest(archive.cells.objectives, archive.cells.solutions, archive.cells.measures)


def center(search):
    """What a restart puts on an elite."""
    return search.theta if isinstance(search, MegaSearch) else search.strategy.mean


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_fills_the_archive_and_finds_the_optimum(name):
    archive = found(name, QUADRATIC)
    assert len(archive.occupied) > 40
    assert archive.costs.min() < 0.02
    np.testing.assert_array_equal(archive.costs, Landscape(QUADRATIC).costs(archive.solutions))
    measures = archive.cells.measures[archive.occupied]
    np.testing.assert_array_equal(measures, archive.solutions[:, :2])
    offers = archive.add(archive.solutions, -archive.costs, measures=measures)
    np.testing.assert_array_equal(offers.cells, archive.occupied)


@pytest.mark.parametrize("name", SEARCHES)
def test_iterations_between_calls_change_no_byte(name):
    assert (
        len({bytes_of(found(name, QUADRATIC, interval=interval)) for interval in (0, 1, 7, 25)})
        == 1
    )


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("kind", [NAN, INFINITE])
def test_costs_that_are_not_finite_leave_the_archive_empty(name, kind):
    assert len(found(name, kind).occupied) == 0


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_lives_with_costs_of_which_some_are_nan(name):
    archive = found(name, NAN_BEYOND)
    assert len(archive.occupied) > 20
    assert np.isfinite(archive.costs).all()
    assert (np.abs(archive.solutions[:, 3]) <= 0.25).all()


@pytest.mark.parametrize("name", SEARCHES)
def test_without_improvement_it_restarts_from_the_chosen_elite(name):
    stepper = Stepper(name)
    for _ in range(8):
        stepper.step(QUADRATIC)
    strategy = stepper.search.strategy
    assert strategy.sigma[0] != 0.2
    elite = int(stepper.elites[stepper.iteration] * len(stepper.archive.occupied))
    before = bytes_of(stepper.archive)
    stepper.step(NAN)
    assert bytes_of(stepper.archive) == before
    np.testing.assert_array_equal(center(stepper.search), stepper.archive.solutions[elite])
    assert strategy.sigma[0] == 0.2
    assert strategy.evaluations[0] == 0
    np.testing.assert_array_equal(strategy.covariance, np.eye(len(strategy.mean)))
    if name == "cma_mega":
        np.testing.assert_array_equal(strategy.mean, np.zeros(3))
        np.testing.assert_array_equal(stepper.search.adam.moments, np.zeros((2, 4)))
        np.testing.assert_array_equal(stepper.search.adam.powers, np.ones(2))


@pytest.mark.parametrize("name", SEARCHES)
def test_a_tiny_step_restarts_a_search_although_it_improved(name):
    stepper = Stepper(name)
    stepper.search.strategy.sigma[0] = 1e-13
    stepper.step(QUADRATIC)
    assert len(stepper.archive.occupied) > 0
    assert stepper.search.strategy.sigma[0] == 0.2


@pytest.mark.parametrize("name", SEARCHES)
def test_on_a_flat_cost_it_restarts_as_soon_as_all_rank_alike(name):
    stepper = Stepper(name)
    restarts = 0
    for _ in range(30):
        stepper.step(FLAT)
        restarts += int(stepper.search.strategy.evaluations[0] == 0)
    assert restarts > 5
    np.testing.assert_array_equal(stepper.archive.costs, 1.0)
