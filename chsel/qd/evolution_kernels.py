"""The evolution strategy inside both emitters: CMA-ES with a varying number of parents."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import inner
from chsel.numerics.eigen import decompose
from chsel.numerics.elementary import exp, logs

_MAX_CONDITION = 1e14
_SMALLEST_STEP = 1e-11
_SMALLEST_EIGENVALUE = 1e-300
_FLAT = 1e-12


class Strategy(NamedTuple):
    """State of covariance matrix adaptation (Hansen, 2016, "The CMA Evolution Strategy").

    Parents may be any number of the batch, as quality diversity takes those that changed the
    archive (Fontaine et al., 2020).
    """

    batch: int  # L
    sigma0: float  # first step size
    ribs_parity: bool  # divide no evolution path by sigma and apply c1 twice, as pyribs does
    mean: FloatArray  # (n,)
    path_c: FloatArray  # (n,)
    path_s: FloatArray  # (n,)
    covariance: FloatArray  # (n, n)
    eigenvalues: FloatArray  # (n,), of the covariance at the last decomposition
    eigenvectors: FloatArray  # (n, n), in columns
    sigma: FloatArray  # (1,), step size
    evaluations: IntArray  # (1,), since the reset
    decomposed_at: IntArray  # (1,), evaluations at the last decomposition
    gap: FloatArray  # (1,), evaluations between two decompositions: by the rates of L / 2 parents
    logarithms: FloatArray  # (2, L), ln i and ln(i + 1/2), from i = 1
    weights: FloatArray  # (L,), of the last parents
    scratch: FloatArray  # (2, n)
    work: FloatArray  # (n, n), scratch


def strategy_around(
    mean: FloatArray, batch: int, *, sigma0: float, ribs_parity: bool = False
) -> Strategy:
    """Return a new strategy around `mean` (n,)."""
    n = len(mean)
    ranks = np.arange(1.0, batch + 1.0)
    return Strategy(
        batch=batch,
        sigma0=float(sigma0),
        ribs_parity=bool(ribs_parity),
        mean=np.array(mean, dtype=np.float64),
        path_c=np.zeros(n),
        path_s=np.zeros(n),
        covariance=np.eye(n),
        eigenvalues=np.ones(n),
        eigenvectors=np.eye(n),
        sigma=np.array([float(sigma0)]),
        evaluations=np.zeros(1, dtype=np.int64),
        decomposed_at=np.zeros(1, dtype=np.int64),
        gap=np.zeros(1),
        logarithms=np.stack([logs(ranks), logs(ranks + 0.5)]),
        weights=np.zeros(batch),
        scratch=np.zeros((2, n)),
        work=np.zeros((n, n)),
    )


@inner
def reset(strategy: Strategy) -> None:
    """Restart around the mean."""
    n = len(strategy.mean)
    for i in range(n):
        strategy.path_c[i] = strategy.path_s[i] = 0.0
        strategy.eigenvalues[i] = 1.0
        for j in range(n):
            entry = 1.0 if i == j else 0.0
            strategy.covariance[i, j] = strategy.eigenvectors[i, j] = entry
    strategy.sigma[0] = strategy.sigma0
    strategy.evaluations[0] = strategy.decomposed_at[0] = 0


@inner
def ask(strategy: Strategy, normals: FloatArray, samples: FloatArray) -> None:
    """Fill samples (L, n), m + sigma B D z, from standard normal draws z (L, n)."""
    mean = strategy.mean
    values = strategy.eigenvalues
    vectors = strategy.eigenvectors
    n, evaluations = len(mean), strategy.evaluations[0]
    if evaluations == 0:
        mueff = _weigh(strategy.logarithms, max(strategy.batch // 2, 1), strategy.weights)
        _, _, c1, cmu, _ = _learning_rates(n, mueff)
        strategy.gap[0] = 0.5 * n * strategy.batch / ((c1 + cmu) * n * n)
    elif evaluations > strategy.decomposed_at[0] + strategy.gap[0]:
        decompose(strategy.covariance, strategy.work, values, vectors)
        for e in range(n):
            values[e] = max(values[e], _SMALLEST_EIGENVALUE)
        strategy.decomposed_at[0] = evaluations
    for i in range(len(samples)):
        for j in range(n):
            samples[i, j] = mean[j]
        for e in range(n):
            along = strategy.sigma[0] * np.sqrt(values[e]) * normals[i, e]
            for j in range(n):
                samples[i, j] += along * vectors[j, e]


@inner
def _weigh(logarithms: FloatArray, parents: int, weights: FloatArray) -> float:
    """Fill the weights of ranked parents, ln(mu + 1/2) - ln i, summing to 1; returns mu_eff."""
    total, squares = 0.0, 0.0
    for i in range(parents):
        weights[i] = logarithms[1, parents - 1] - logarithms[0, i]
        total += weights[i]
    for i in range(parents):
        weights[i] /= total
        squares += weights[i] * weights[i]
    return 1.0 / squares


@inner
def _learning_rates(n: int, mueff: float) -> tuple[float, float, float, float, float]:
    """Return c_c, c_sigma, c_1, c_mu and d_sigma for n dimensions."""
    cc = (4.0 + mueff / n) / (n + 4.0 + 2.0 * mueff / n)
    cs = (mueff + 2.0) / (n + mueff + 5.0)
    c1 = 2.0 / ((n + 1.3) * (n + 1.3) + mueff)
    cmu = 2.0 * (mueff - 2.0 + 1.0 / mueff) / ((n + 2.0) * (n + 2.0) + mueff)
    damping = 1.0 + 2.0 * max(0.0, np.sqrt((mueff - 1.0) / (n + 1.0)) - 1.0) + cs
    return cc, cs, c1, min(1.0 - c1, cmu), damping


@inner
def tell(strategy: Strategy, samples: FloatArray, order: IntArray, parents: int) -> None:
    """Learn from samples (L, n) with their order (L,), of which the first `parents` succeeded."""
    mean, weights = strategy.mean, strategy.weights
    path_c, path_s = strategy.path_c, strategy.path_s
    strategy.evaluations[0] += strategy.batch
    if parents == 0:
        return
    n, sigma = len(mean), strategy.sigma[0]
    mueff = _weigh(strategy.logarithms, parents, weights)
    cc, cs, c1, cmu, damping = _learning_rates(n, mueff)
    step, whitened = strategy.scratch[0], strategy.scratch[1]
    for j in range(n):
        step[j] = whitened[j] = 0.0
    for i in range(parents):
        for j in range(n):
            step[j] += weights[i] * (samples[order[i], j] - mean[j])
    _whiten(strategy.eigenvalues, strategy.eigenvectors, step, whitened)
    rate = np.sqrt(cs * (2.0 - cs) * mueff) / sigma
    length = 0.0
    for j in range(n):
        path_s[j] = (1.0 - cs) * path_s[j] + rate * whitened[j]
        length += path_s[j] * path_s[j]
    length /= n
    generation = strategy.evaluations[0] // strategy.batch
    steady = length / (1.0 - _power(1.0 - cs, 2 * generation)) < 2.0 + 4.0 / (n + 1.0)
    rate = np.sqrt(cc * (2.0 - cc) * mueff) if steady else 0.0
    if not strategy.ribs_parity:
        rate /= sigma
    for j in range(n):
        path_c[j] = (1.0 - cc) * path_c[j] + rate * step[j]
    c1a = c1 if steady else c1 * (1.0 - cc * (2.0 - cc))
    kept, one = 1.0 - c1a - cmu, c1 * c1 if strategy.ribs_parity else c1
    _add_rank_one(strategy.covariance, kept, one, path_c)
    for i in range(parents):
        for j in range(n):
            whitened[j] = samples[order[i], j] - mean[j]
        _add_rank_one(strategy.covariance, 1.0, cmu * weights[i] / (sigma * sigma), whitened)
    for j in range(n):
        mean[j] += step[j]
    strategy.sigma[0] = sigma * exp(min(1.0, (cs / damping) * (length - 1.0) / 2.0))


@inner
def _whiten(values: FloatArray, vectors: FloatArray, step: FloatArray, out: FloatArray) -> None:
    """Add C^(-1/2) y to out (n,), of a step y (n,)."""
    n = len(step)
    for e in range(n):
        along = 0.0
        for j in range(n):
            along += vectors[j, e] * step[j]
        along /= np.sqrt(values[e])
        for j in range(n):
            out[j] += along * vectors[j, e]


@inner
def _power(base: float, exponent: int) -> float:
    """Return base^exponent by repeated squaring."""
    result = 1.0
    while exponent > 0:
        if exponent % 2 == 1:
            result *= base
        base *= base
        exponent //= 2
    return result


@inner
def _add_rank_one(covariance: FloatArray, kept: float, scale: float, vector: FloatArray) -> None:
    """Replace C by kept C + scale v v^T."""
    for j in range(len(vector)):
        for k in range(j + 1):
            entry = kept * covariance[j, k] + scale * (vector[j] * vector[k])
            covariance[j, k] = covariance[k, j] = entry


@inner
def stopped(strategy: Strategy, order: IntArray, status: IntArray, value: FloatArray) -> bool:
    """Return whether to restart: degenerate covariance, tiny step, or a flat ranking."""
    values, last = strategy.eigenvalues, len(order) - 1
    smallest, largest = values[0], values[len(values) - 1]
    if largest / smallest > _MAX_CONDITION:
        return True
    if strategy.sigma[0] * np.sqrt(largest) < _SMALLEST_STEP:
        return True
    by_status = float(status[order[0]] - status[order[last]])
    by_value = value[order[0]] - value[order[last]]
    return last > 0 and np.sqrt(by_status * by_status + by_value * by_value) < _FLAT
