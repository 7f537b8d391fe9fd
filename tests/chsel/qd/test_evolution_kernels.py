"""The compiled evolution strategy against CMA-ES written with matrices."""

import numba
import numpy as np
import pytest

from chsel.qd import evolution_kernels as evolution
from chsel.qd.evolution_kernels import strategy_around


class MatrixStrategy:
    """Hansen's tutorial with positive weights of any number of parents."""

    def __init__(self, mean, batch, *, sigma, parity):
        n = len(mean)
        self.n = n
        self.batch = batch
        self.parity = parity
        self.mean = mean
        self.sigma = sigma
        self.covariance = np.eye(n)
        self.path_c, self.path_s = np.zeros(n), np.zeros(n)
        self.values, self.vectors = np.ones(n), np.eye(n)
        self.told = self.decomposed_at = 0
        c1, cmu = self.rates(max(batch // 2, 1))[3:5]
        self.gap = batch / (2.0 * (c1 + cmu) * n)

    def rates(self, mu):
        n = self.n
        raw = np.log(mu + 0.5) - np.log(np.arange(mu) + 1.0)
        weights = raw / raw.sum()
        m = 1.0 / (weights @ weights)
        cc = (4.0 + m / n) / (n + 4.0 + 2.0 * m / n)
        cs = (m + 2.0) / (n + m + 5.0)
        c1 = 2.0 / ((n + 1.3) ** 2 + m)
        cmu = min(1.0 - c1, 2.0 * (m - 2.0 + 1.0 / m) / ((n + 2.0) ** 2 + m))
        damping = 1.0 + 2.0 * max(0.0, np.sqrt((m - 1.0) / (n + 1.0)) - 1.0) + cs
        return weights, cc, cs, c1, cmu, damping, m

    def ask(self, normals, vectors):
        """Samples; `vectors` settle signs, and the basis where eigenvalues are equal."""
        if self.told > self.decomposed_at + self.gap:
            self.values = np.linalg.eigvalsh(self.covariance)
            self.vectors = vectors.copy()
            self.decomposed_at = self.told
            np.testing.assert_allclose(vectors.T @ vectors, np.eye(self.n), atol=1e-13)
            back = vectors @ np.diag(self.values) @ vectors.T
            np.testing.assert_allclose(back, self.covariance, rtol=1e-12, atol=1e-12)
        root = self.vectors @ np.diag(np.sqrt(self.values))
        return self.mean + self.sigma * normals @ root.T

    def tell(self, parents):
        self.told += self.batch
        if len(parents) == 0:
            return
        weights, cc, cs, c1, cmu, damping, m = self.rates(len(parents))
        steps = (parents - self.mean) / self.sigma
        step = weights @ steps
        inverse_root = self.vectors @ np.diag(self.values**-0.5) @ self.vectors.T
        rate = np.sqrt(cs * (2.0 - cs) * m)
        self.path_s = (1.0 - cs) * self.path_s + rate * inverse_root @ step
        length = self.path_s @ self.path_s / self.n
        fresh = 1.0 - (1.0 - cs) ** (2 * self.told / self.batch)
        steady = length / fresh < 2.0 + 4.0 / (self.n + 1.0)
        rate = steady * np.sqrt(cc * (2.0 - cc) * m) * (self.sigma if self.parity else 1.0)
        self.path_c = (1.0 - cc) * self.path_c + rate * step
        c1a = c1 * (1.0 - (1.0 - steady) * cc * (2.0 - cc))
        self.covariance = (
            (1.0 - c1a - cmu) * self.covariance
            + (c1**2 if self.parity else c1) * np.outer(self.path_c, self.path_c)
            + cmu * steps.T @ np.diag(weights) @ steps
        )
        self.mean = weights @ parents
        self.sigma *= np.exp(min(1.0, cs / damping * (length - 1.0) / 2.0))


@numba.njit
def ask(strategy, normals, samples):
    evolution.ask(strategy, normals, samples)


@numba.njit
def tell(strategy, samples, order, parents):
    evolution.tell(strategy, samples, order, parents)


@numba.njit
def reset(strategy):
    evolution.reset(strategy)


@numba.njit
def stopped(strategy, order, status, value):
    return evolution.stopped(strategy, order, status, value)


@pytest.mark.parametrize("parity", [False, True])
@pytest.mark.parametrize(("n", "batch"), [(2, 29), (3, 29), (9, 30), (7, 5), (4, 1)])
def test_samples_are_those_of_cma_es_with_matrices(n, batch, parity):
    random = np.random.default_rng(n)
    mean = random.standard_normal(n)
    samples = np.zeros((batch, n))
    ours = strategy_around(mean, batch, sigma0=0.7, ribs_parity=parity)
    theirs = MatrixStrategy(mean, batch, sigma=0.7, parity=parity)
    centre = random.standard_normal(n)
    weights = 1.0 + np.arange(n)
    steady = 0
    for iteration in range(25):
        normals = random.standard_normal((batch, n))
        ask(ours, normals, samples)
        expected = theirs.ask(normals, ours.eigenvectors)
        np.testing.assert_allclose(samples, expected, rtol=1e-9, atol=1e-9)
        order = np.argsort((((samples - centre) * weights) ** 2).sum(axis=1))
        parents = iteration * 7 % (batch + 1)  # none, some, all
        tell(ours, samples, order, parents)
        theirs.tell(samples[order[:parents]])
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(ours.covariance, ours.covariance.T)
        assert ours.sigma[0] == pytest.approx(theirs.sigma, rel=1e-10)
        steady += bool(np.abs(theirs.path_c).max() > 0.0)
    assert steady > 10
    assert theirs.decomposed_at > 0


@pytest.mark.parametrize("told", [0, 2, 4])
@pytest.mark.parametrize(("share", "steady"), [(0.7, True), (0.99, True), (1.01, False)])
def test_path_c_waits_while_path_s_is_too_long(told, share, steady):
    # For n = 3, one parent, sigma = 1, c_s = 1 / 3: |p_s|^2 / n = |y|^2 5 / 27, and steady where
    # it is below 3 (1 - (1 - c_s)^(2 t)), t batches told.
    strategy = strategy_around(np.zeros(3), 5, sigma0=1.0)
    strategy.evaluations[0] = 5 * told
    samples = np.zeros((5, 3))
    samples[2, 1] = np.sqrt(share * 16.2 * (1.0 - (2.0 / 3.0) ** (2 * told + 2)))
    tell(strategy, samples, np.array([2, 0, 1, 3, 4]), 1)
    assert (strategy.path_c[1] > 0.0) == steady


def strategy_and_ranking(batch):
    order = np.arange(batch)
    return strategy_around(np.zeros(3), batch, sigma0=0.5), order, np.ones_like(order), -1.0 * order


def test_it_stops_at_a_degenerate_covariance_a_tiny_step_or_a_flat_ranking():
    strategy, order, status, value = strategy_and_ranking(4)
    assert not stopped(strategy, order, status, value)
    strategy.eigenvalues[:] = 1.0, 2.0, 0.99e14
    assert not stopped(strategy, order, status, value)
    strategy.eigenvalues[:] = 1.0, 2.0, 1.01e14
    assert stopped(strategy, order, status, value)
    strategy.eigenvalues[:] = 1.0, 2.0, 4.0
    strategy.sigma[0] = 0.51e-11
    assert not stopped(strategy, order, status, value)
    strategy.sigma[0] = 0.49e-11
    assert stopped(strategy, order, status, value)
    strategy.sigma[0] = 1.0
    flat = np.linspace(1e-13, 0.0, 4)
    assert stopped(strategy, order, status, flat)
    assert not stopped(strategy, order, np.array([2, 1, 1, 1]), flat)
    assert not stopped(strategy, order, status, np.array([0.0, 0.0, 0.0, -np.inf]))
    assert not stopped(*strategy_and_ranking(1))


def test_a_reset_strategy_is_a_new_one_around_its_mean():
    random = np.random.default_rng(5)
    strategy = strategy_and_ranking(6)[0]
    new = strategy_around(np.ones(3), 6, sigma0=0.5)
    samples = np.zeros((6, 3))
    for _ in range(5):
        ask(strategy, random.standard_normal((6, 3)), samples)
        tell(strategy, samples, np.arange(6), 3)
    assert strategy.evaluations[0] == 30
    assert strategy.decomposed_at[0] > 0
    strategy.mean[:] = 1.0
    reset(strategy)
    normals = random.standard_normal((5, 6, 3))
    for draws in normals:
        for each in (strategy, new):
            ask(each, draws, samples)
            tell(each, samples, np.arange(6), 4)
    for mine, other in zip(strategy[3:13], new[3:13], strict=True):
        np.testing.assert_array_equal(mine, other)
