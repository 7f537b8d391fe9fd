"""The evolution strategy inside both emitters: CMA-ES with a varying number of parents."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray, IntArray

_MAX_CONDITION = 1e14
_SMALLEST_STEP = 1e-11
_FLAT = 1e-12


class EvolutionStrategy:
    """Covariance matrix adaptation (Hansen, 2016, "The CMA Evolution Strategy: A Tutorial").

    dimension n, batch L, first step size sigma0. Parents may be any number of the batch, as
    quality diversity takes those that changed the archive (Fontaine et al., 2020).
    ribs_parity: divide no evolution path by sigma and apply c1 twice, as pyribs does.
    """

    def __init__(
        self, dimension: int, batch: int, sigma0: float, *, ribs_parity: bool = False
    ) -> None:
        self.dimension, self.batch = dimension, batch
        self._sigma0 = sigma0
        self._parity = ribs_parity
        half = _Constants(dimension, batch // 2)
        self._gap = 0.5 * dimension * batch / ((half.c1 + half.cmu) * dimension**2)
        self.reset(np.zeros(dimension))

    def reset(self, mean: FloatArray) -> None:
        """Start again around `mean` (n,)."""
        self.mean = mean.copy()
        self.sigma = self._sigma0
        self.covariance = np.eye(self.dimension)
        self._path_c = np.zeros(self.dimension)
        self._path_s = np.zeros(self.dimension)
        self._evaluations = 0
        self._decompose()

    def ask(self, normals: FloatArray) -> FloatArray:
        """Samples (L, n) from standard normal draws (L, n)."""
        if self._evaluations > self._decomposed_at + self._gap:
            self._decompose()
        scaled = normals * self.sigma * np.sqrt(self._eigenvalues)
        return self.mean + scaled @ self._eigenvectors.T

    def tell(self, ranked: FloatArray, parents: int) -> None:
        """Learn from samples (L, n), best first, of which the first `parents` succeeded."""
        self._evaluations += self.batch
        if parents == 0:
            return
        n = self.dimension
        k = _Constants(n, parents)
        weights = recombination_weights(parents)
        old_mean = self.mean
        self.mean = (weights[:, None] * ranked[:parents]).sum(axis=0)
        y = self.mean - old_mean
        whitened = self._eigenvectors @ ((self._eigenvectors.T @ y) / np.sqrt(self._eigenvalues))
        rate = np.sqrt(k.cs * (2.0 - k.cs) * k.mueff) / self.sigma
        self._path_s = (1.0 - k.cs) * self._path_s + rate * whitened
        length = (self._path_s**2).sum() / n
        fresh = 1.0 - (1.0 - k.cs) ** (2.0 * self._evaluations / self.batch)
        steady = float(length / fresh < 2.0 + 4.0 / (n + 1.0))
        rate = steady * np.sqrt(k.cc * (2.0 - k.cc) * k.mueff)
        self._path_c = (1.0 - k.cc) * self._path_c + rate * y / (
            1.0 if self._parity else self.sigma
        )
        self._adapt_covariance(ranked[:parents] - old_mean, weights, k, steady)
        self.sigma *= np.exp(min(1.0, (k.cs / k.damps) * (length - 1.0) / 2.0))

    def _adapt_covariance(
        self, steps: FloatArray, weights: FloatArray, k: _Constants, steady: float
    ) -> None:
        c1a = k.c1 * (1.0 - (1.0 - steady) * k.cc * (2.0 - k.cc))
        rank_one = k.c1 * np.outer(self._path_c, self._path_c)
        if self._parity:
            rank_one = k.c1 * rank_one
        rank_mu = (k.cmu / self.sigma**2) * np.einsum("i,ij,ik->jk", weights, steps, steps)
        self.covariance = (1.0 - c1a - k.cmu) * self.covariance + rank_one + rank_mu

    def stopped(self, ranking: FloatArray) -> bool:
        """Whether to restart: degenerate covariance, tiny step, or a flat ranking (L, r)."""
        eigenvalues = self._eigenvalues
        if eigenvalues.max() / eigenvalues.min() > _MAX_CONDITION:
            return True
        if self.sigma * np.sqrt(eigenvalues.max()) < _SMALLEST_STEP:
            return True
        return len(ranking) >= 2 and float(np.sqrt(((ranking[0] - ranking[-1]) ** 2).sum())) < _FLAT

    def _decompose(self) -> None:
        self.covariance = (self.covariance + self.covariance.T) / 2.0
        eigenvalues, self._eigenvectors = np.linalg.eigh(self.covariance)
        self._eigenvalues = np.maximum(eigenvalues, 1e-300)
        self._decomposed_at = self._evaluations


class _Constants:
    """Learning rates for n dimensions and mu parents."""

    def __init__(self, n: int, mu: int) -> None:
        weights = recombination_weights(max(mu, 1))
        m = 1.0 / (weights**2).sum()
        self.mueff = m
        self.cc = (4.0 + m / n) / (n + 4.0 + 2.0 * m / n)
        self.cs = (m + 2.0) / (n + m + 5.0)
        self.c1 = 2.0 / ((n + 1.3) ** 2 + m)
        self.cmu = min(1.0 - self.c1, 2.0 * (m - 2.0 + 1.0 / m) / ((n + 2.0) ** 2 + m))
        self.damps = 1.0 + 2.0 * max(0.0, np.sqrt((m - 1.0) / (n + 1.0)) - 1.0) + self.cs


def recombination_weights(parents: int) -> FloatArray:
    """Weights (mu,) of ranked parents: ln(mu + 1/2) - ln i, summing to 1."""
    raw = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    return raw / raw.sum()


def rank_by_improvement(status: IntArray, value: FloatArray) -> IntArray:
    """Order (B,) of a batch, best first: by status, then by value; ties the later first."""
    return np.lexsort((value, status))[::-1]
