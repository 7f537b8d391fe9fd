"""The compiled search gives the archive of pyribs, by shared random numbers."""

from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

import chsel.qd.emitters
from chsel.numerics.arrays import FloatArray
from chsel.numerics.pose_tuples import SpaceConstants
from chsel.problem.registration_problem import NullObserver
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd.archive import GridArchive
from chsel.qd.emitters import EmitterSettings, fill_archive, mega_search
from chsel.qd.measures import VECTOR, Measure, MeasureCode

ribs_archives = pytest.importorskip("ribs.archives", reason="pyribs is a test dependency")
ribs_emitters = pytest.importorskip("ribs.emitters", reason="pyribs is a test dependency")

BINS = 40
LOWER = np.array([-0.5, -0.5])
UPPER = np.array([0.5, 0.5])
BATCH = 29
ITERATIONS = 100


class Parameters(NamedTuple):
    """Of the quadratic, as the compiled searches take them."""

    centre: FloatArray
    weights: FloatArray


class Quadratic:
    """Cost |A (x - c)|^2 over 9 dimensions; the measures are the last coordinates but one."""

    def __init__(self):
        self.model = Parameters(np.linspace(-0.3, 0.3, 9), np.linspace(1.0, 3.0, 9))
        self.space_arrays = SpaceConstants()

    def work(self):
        return 0

    def costs(self, vectors):
        return ((self.model.weights * (vectors - self.model.centre)) ** 2).sum(axis=1)

    def costs_and_gradients(self, vectors):
        return self.costs(vectors), 2.0 * self.model.weights**2 * (vectors - self.model.centre)


@numba.njit
def cost_of(model, space, vector, work):
    total = 0.0
    for j in range(9):
        total += (model.weights[j] * (vector[j] - model.centre[j])) ** 2
    return total


@numba.njit
def cost_and_gradient_of(model, space, vector, gradient, work):
    for j in range(9):
        gradient[j] = 2.0 * model.weights[j] ** 2 * (vector[j] - model.centre[j])
    return cost_of(model, space, vector, work)


@pytest.fixture(scope="module", autouse=True)
def searches_of_the_quadratic(searches_around):
    searches_around(cost_of, cost_and_gradient_of)


MEASURE = Measure(("x", "y"), MeasureCode(VECTOR, 2, first=6))
START = np.linspace(0.4, -0.2, 9)


def search(name, seed, **settings):
    """Our search on the quadratic."""
    archive = GridArchive(MEASURE, LOWER, upper=UPPER, bins=BINS, dimension=9)
    quadratic: Any = Quadratic()
    archive.add(START[None], -quadratic.costs(START[None]), measures=START[None, 6:8])
    count = BATCH + 1 if name == "cma_mega" else BATCH
    options = EmitterSettings(ITERATIONS, **{"sigma0": 1.0, "rate": 0.05, **settings})
    key = StreamKey(seed, 0)
    fill_archive(
        name,
        quadratic,
        archive=archive,
        start=START,
        count=count,
        settings=options,
        key=key,
        observer=NullObserver(),
    )
    return archive


class SharedNormals:
    """Stands in for the generator of a pyribs strategy: our draws, in our order.

    Draws are coordinates along eigenvectors, whose signs are anybody's choice; so each gets the
    sign that turns pyribs' eigenvector into ours, of which the largest entry is positive.
    """

    def __init__(self, strategy, normals):
        self._strategy = strategy
        self._rows = iter(normals)

    def normal(self, mean, sigma, shape):
        rows = next(self._rows)
        assert rows.shape == shape
        basis = self._strategy.cov.eigenbasis
        largest = np.abs(basis).argmax(axis=0)
        signs = np.sign(np.take_along_axis(basis, largest[None], axis=0))
        return mean + sigma * rows * signs


def ribs_archive():
    ranges = list(zip(LOWER, UPPER, strict=True))
    return ribs_archives.GridArchive(
        solution_dim=9, dims=[BINS, BINS], ranges=ranges, qd_score_offset=-100.0, epsilon=1e-6
    )


def ribs_emitter(name, archive, *, seed, sigma0):
    common = {
        "x0": START,
        "sigma0": sigma0,
        "ranker": "2imp",
        "selection_rule": "filter",
        "restart_rule": "no_improvement",
        "batch_size": BATCH,
        "seed": seed,
    }
    if name == "cma_me":
        return ribs_emitters.EvolutionStrategyEmitter(archive, **common)
    adam = {"grad_opt": "adam", "grad_opt_kwargs": {"epsilon": 0.0}, "normalize_grad": True}
    return ribs_emitters.GradientArborescenceEmitter(archive, lr=0.05, **adam, **common)


def ribs_search(name, seed, *, sigma0):
    """The same search by pyribs with our random numbers."""
    quadratic: Any = Quadratic()
    archive = ribs_archive()
    emitter = ribs_emitter(name, archive, seed=seed, sigma0=sigma0)
    dimension = 9 if name == "cma_me" else 3
    key = StreamKey(seed, 0)
    drawn = normals(key.stream(Purpose.EMITTER), (ITERATIONS, BATCH, dimension))
    emitter._opt._rng = SharedNormals(emitter._opt, drawn)
    elites = key.stream(Purpose.RESTART).random(ITERATIONS)

    def our_elite(count, **_):
        data = archive.data(["solution", "index"], return_type="dict")
        order = np.argsort(data["index"])
        chosen = order[int(elites[iteration] * len(order))]
        return {"solution": data["solution"][chosen][None]}

    archive.sample_elites = our_elite
    archive.add(START[None], -quadratic.costs(START[None]), measures=START[None, 6:8])
    for iteration in range(ITERATIONS):  # noqa: B007  read by our_elite
        if name == "cma_mega":
            theta = emitter.ask_dqd()
            cost, gradient = quadratic.costs_and_gradients(theta)
            info = archive.add(theta, -cost, measures=theta[:, 6:8])
            jacobian = np.concatenate([-gradient, np.eye(9)[6:8]])[None]
            emitter.tell_dqd(theta, -cost, theta[:, 6:8], jacobian, info)
        solutions = emitter.ask()
        objective = -quadratic.costs(solutions)
        info = archive.add(solutions, objective, measures=solutions[:, 6:8])
        emitter.tell(solutions, objective, solutions[:, 6:8], info)
    return archive


@pytest.mark.parametrize(
    ("name", "sigma0"), [("cma_mega", 1.0), ("cma_mega", 0.1), ("cma_me", 0.2)]
)
def test_with_its_formulas_and_shared_random_numbers_the_archive_is_that_of_pyribs(
    name, sigma0, monkeypatch
):
    # pyribs adds Adam's epsilon before the bias correction; without it the two are one formula.
    monkeypatch.setattr(chsel.qd.emitters, "mega_search", partial(mega_search, epsilon=0.0))
    ours = search(name, 3, sigma0=sigma0, ribs_parity=True)
    data = ribs_search(name, 3, sigma0=sigma0).data(return_type="dict")
    order = np.argsort(data["index"])
    np.testing.assert_array_equal(ours.occupied, data["index"][order])
    np.testing.assert_allclose(-ours.costs, data["objective"][order], rtol=1e-7)
    np.testing.assert_allclose(ours.solutions, data["solution"][order], rtol=0, atol=1e-7)
    assert len(ours.occupied) > 100
