"""SVGD on the relaxed cost: particles that descend and push each other apart (CHSEL, Sec. V)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import LANES, evaluate, gradient_of, put_pose, work_of
from chsel.cost.cost_settings import CostSettings
from chsel.cost.free_kernels import MOST_SLACK
from chsel.cost.objective import BETA1, BETA2, EPSILON, Objective, adam_step
from chsel.errors import require_at_most
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.elementary import exp, log
from chsel.numerics.pose_tuples import decode, pull_back
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.qd.selection import ranked_hypotheses

_LEAST = 1e-8  # of 2 h^2, which keeps gamma finite
_MOST_REMEMBERED = 40_000_000  # points around all particles, 16 bytes each
MOST_ITERATIONS = 1_000_000
MOST_PARTICLES = 10_000  # numbers are kept for every pair
_BLOCK = 50  # iterations between two calls of the observer


class Particles(NamedTuple):
    """State of the particles, and scratch."""

    vectors: FloatArray  # (B, d)
    moments: FloatArray  # (B, 2, d), of Adam
    powers: FloatArray  # (2,), of Adam
    scores: FloatArray  # (B, d), gradients of log p
    directions: FloatArray  # (B, d), phi
    squares: FloatArray  # (B (B - 1) / 2,), squared distances of pairs
    selected: FloatArray  # of that size, where their median is computed


def particles_at(vectors: FloatArray) -> Particles:
    """Return particles at search vectors (B, d), which are copied."""
    count, dimension = vectors.shape
    moments = np.zeros((count, 2, dimension))
    pairs = np.zeros((2, count * (count - 1) // 2))
    scores, directions = np.zeros((2, count, dimension))
    return Particles(vectors.copy(), moments, np.ones(2), scores, directions, *pairs)


class SteinStep(NamedTuple):
    """Settings of a step of the particles."""

    sharpness: float  # beta
    scale: float  # h of the kernel
    median: bool  # h follows from the particles instead
    rate: float  # of Adam


@compiled
def svgd(
    model: Any, space: Any, particles: Any, around: Any, settings: Any, iterations: Any
) -> None:
    """Move particles up log p = -beta C, and apart, by so many steps (SteinStep) of Adam."""
    vectors, powers = particles.vectors, particles.powers
    for _ in range(iterations):
        for first in range(0, len(vectors), LANES):
            _fill_scores(model, space, particles, around, first, settings.sharpness)
        direct(particles, settings.scale, settings.median)
        powers[0] *= BETA1
        powers[1] *= BETA2
        for n in range(len(vectors)):
            moments = particles.moments[n]
            vector = vectors[n]
            direction = particles.directions[n]
            for j in range(len(vector)):
                vector[j] += adam_step(direction[j], moments, j, powers, settings.rate, EPSILON)


@spliced
def _fill_scores(
    model: Any, space: Any, particles: Any, around: Any, first: Any, sharpness: Any
) -> None:
    """Fill the gradients (LANES, d) of log p from the first of some particles."""
    vectors, lanes = particles.vectors, around.lanes
    count = min(LANES, len(vectors) - first)
    remembers = len(around.near.slack) >= len(vectors)
    for lane in range(count):
        put_pose(lanes, lane, decode(space, vectors[first + lane]))
    slack = MOST_SLACK if remembers else 0.0
    evaluate(model, around, first if remembers else 0, count, slack)
    for lane in range(count):
        score = particles.scores[first + lane]
        pull_back(space, vectors[first + lane], gradient_of(lanes, lane), score)
        for j in range(len(score)):
            score[j] *= -sharpness


@inner
def direct(particles: Any, scale: Any, median: Any) -> None:
    """Fill phi_i = 1/B sum_j k(X_j, X_i) score_j + 2 gamma k(X_j, X_i) (X_i - X_j).

    k(a, b) = exp(-gamma |a - b|^2), gamma = 1 / (2 h^2 + 1e-8), h = scale or, if median, from
    h^2 = median |X_i - X_j|^2 / (2 ln(B + 1)) over pairs (Liu and Wang, 2016, Sec. 5).
    """
    vectors = particles.vectors
    scores = particles.scores
    directions = particles.directions
    count, dimension = vectors.shape
    pair = 0
    for i in range(count):
        for j in range(i):
            total = 0.0
            for d in range(dimension):
                total += (vectors[i, d] - vectors[j, d]) * (vectors[i, d] - vectors[j, d])
            particles.squares[pair] = total
            pair += 1
    square = scale * scale
    if median and count > 1:
        for pair in range(len(particles.squares)):
            particles.selected[pair] = particles.squares[pair]
        square = _median(particles.selected) / (2.0 * log(count + 1.0))
    gamma = 1.0 / (2.0 * square + _LEAST)
    pair = 0
    for i in range(count):
        for d in range(dimension):
            directions[i, d] = scores[i, d]
        for j in range(i):
            near = exp(-gamma * particles.squares[pair])
            pair += 1
            if near > 0.0:
                apart = 2.0 * gamma * near
                for d in range(dimension):
                    push = apart * (vectors[i, d] - vectors[j, d])
                    directions[i, d] += near * scores[j, d] + push
                    directions[j, d] += near * scores[i, d] - push
    for i in range(count):
        for d in range(dimension):
            directions[i, d] /= count


@inner
def _median(values: Any) -> Any:
    """Return the median of values (S,), S > 0, which are reordered."""
    middle = len(values) // 2
    first, last = 0, len(values) - 1
    while first < last:  # quickselect (Hoare, 1961): values of [first, last] hold the middle one
        pivot = values[(first + last) // 2]
        left, right = first, last
        while left <= right:
            while values[left] < pivot:
                left += 1
            while values[right] > pivot:
                right -= 1
            if left <= right:
                values[left], values[right] = values[right], values[left]
                left += 1
                right -= 1
        first, last = (left if middle > right else first), (right if middle < left else last)
    if len(values) % 2 == 1:
        return values[middle]
    below = values[0]
    for n in range(1, middle):
        below = max(below, values[n])
    return 0.5 * (below + values[middle])


@dataclass(frozen=True)
class SvgdSettings(CheckedSettings):
    """Settings of Stein variational gradient descent (Liu and Wang, 2016)."""

    sharpness: Annotated[float, positive] = 5.0  # beta of p = exp(-beta C)
    # "reference" of fixed scale, or "median": the median heuristic, every iteration.
    kernel: Annotated[str, one_of("reference", "median")] = "reference"
    # h of k(a, b) = exp(-|a - b|^2 / (2 h^2)) of search vectors; of the median heuristic where
    # there is no pair.
    scale: Annotated[float, positive] = 0.01
    iterations: Annotated[int, not_negative, at_most(MOST_ITERATIONS)] = 300  # of all particles
    rate: Annotated[float, positive] = 0.005  # of Adam
    cost: CostSettings = field(default_factory=CostSettings)  # C, the relaxed cost
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {}  # those of its groups


class Svgd(ConfiguredMethod[SvgdSettings]):
    """Moves a particle from every pose of E_0 and returns where they arrive; E_l is not used."""

    settings_class = SvgdSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        require_at_most("number of poses in E_0", len(problem.initial_set), most=MOST_PARTICLES)
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        settings = self.settings
        total = self.settings.iterations
        median = settings.kernel == "median"
        step = SteinStep(settings.sharpness, settings.scale, median=median, rate=settings.rate)
        particles = particles_at(space.encode(Poses.of(problem.initial_set)))
        vectors = particles.vectors
        # Scratch in which particles remember their neighbours, if it is not too large.
        size = len(vectors) * objective.model.free.tree.points.shape[1]
        remembered = len(vectors) if size <= _MOST_REMEMBERED else LANES
        around = work_of(objective.model, remembered)
        observer.trace("svgd", 0, vectors.copy(), objective.costs(vectors))
        for first in range(0, total, _BLOCK):
            last = min(first + _BLOCK, total)
            svgd(objective.model, space.arrays, particles, around, step, last - first)
            observer.trace("svgd", last, vectors.copy(), objective.costs(vectors))
            observer.progress("svgd", last, total)
        estimates = space.poses(vectors)
        return ranked_hypotheses(objective, estimates, elites=estimates)
