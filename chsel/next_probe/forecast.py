"""The belief in the pose, the forecast of each action, and the surprise of an outcome."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.next_probe.decision_problem import Decision, DecisionProblem, WeightedPoses
from chsel.next_probe.first_contact import (
    ContactNormals,
    FirstContacts,
    contact_normals,
    first_contacts,
)
from chsel.numerics.arrays import BoolArray, FloatArray, evenly_spaced, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, exp_in_lanes, exps, log, logs
from chsel.numerics.threads import parallel_for
from chsel.problem.noise import FACET, WRONG_NORMALS
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_distances import distances_apart
from chsel.problem.poses import Poses, compose, inverse, random_rotations, rotated
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.problem.surface import (
    in_order,
    object_centre,
    outline_in_world,
    signed_distances,
    surface_spread,
)

MOST_POSES = 2000
LANES = 32  # actions whose gains are computed together, in vector instructions
# Rows of numbers of a pose, one for each lane: where the hand meets the object, and if it does, 1,
_X, _Y, _Z, _HIT = (np.uint64(n * LANES) for n in range(4))
# and sums over all poses: of weights times overlaps; of weights times squared overlaps, these times
# distances, and times squared distances.
_ALIKE, _ALIVE, _FAR, _FARTHER = (np.uint64(n * LANES) for n in range(4, 8))
_SIZE = 8 * LANES
_DRAWN = 1000  # poses before any registration, of which those that free space allows are kept
_SOME_FREE = 2000  # free points that rule most of these out, before all are compared
_FARTHEST = 60.0  # exponents beyond count as zero
_UNLIKE = 0.01  # overlap of a hit with a miss: a sensor may err
_NONE_OF_THESE = 0.05  # weight of all that the belief leaves out
_ANY_OUTCOME = 0.01  # chance of what happened if none of the poses is right
_WRONG = 0.001  # likelihood of a hit where a pose forecasts a miss, and the other way round
_NO_NORMALS = ContactNormals(np.zeros((0, 0, 3)), np.zeros((0, 0)))


@dataclass(frozen=True)
class BeliefSettings(CheckedSettings):
    """The poses that a decision weighs up."""

    poses: Annotated[int, positive, at_most(MOST_POSES)] = 100  # K, at most
    # Height in the world of the floor that the object lies on, metres; None: it may be anywhere.
    floor: float | None = 0.0


def belief_after(hypotheses: Hypotheses, settings: BeliefSettings) -> WeightedPoses:
    """Return the candidates of a registration, else its hypotheses, all with one weight."""
    poses = hypotheses.candidates
    if len(poses) == 0:
        poses = hypotheses.object_from_world[~hypotheses.duplicate]
    poses = poses[evenly_spaced(len(poses), settings.poses)]
    return WeightedPoses(poses, np.full(len(poses), 1.0 / len(poses)))


def belief_before(
    sdf: SdfGrid,
    points: KnownPoints,
    *,
    workspace: Workspace,
    key: StreamKey,
    settings: BeliefSettings,
) -> WeightedPoses:
    """Return poses with the centre in the workspace, turned any way, that free points allow.

    The first of those drawn that free space does not enter by more than its grid's resolution; if
    they are too few, those that it enters least.
    """
    stream = key.stream(Purpose.PRIOR_BELIEF)
    rotation = random_rotations(stream, _DRAWN)  # world_from_object
    centre = uniforms(stream, workspace.lower, upper=workspace.upper, shape=(_DRAWN, 3))
    position = centre - rotated(rotation, object_centre(sdf))
    poses = Poses.of(inverse(compose(rotation, position)))
    if settings.floor is not None:
        position[:, 2] -= heights(sdf, poses, floor=settings.floor)
        poses = Poses.of(inverse(compose(rotation, position)))
    free = points.free
    depth = _depths(sdf, poses, free=free[evenly_spaced(len(free), _SOME_FREE)])
    missing = settings.poses
    for n in np.flatnonzero(depth <= sdf.resolution):
        if missing == 0:
            break
        depth[n] = _depths(sdf, poses[n : n + 1], free=free)[0]
        missing -= depth[n] <= sdf.resolution
    order = np.argsort(depth, kind="stable")[: settings.poses]
    return WeightedPoses(poses.matrices[order], np.full(len(order), 1.0 / len(order)))


def _depths(sdf: SdfGrid, poses: Poses, *, free: FloatArray) -> FloatArray:
    """Return depth (B,) of the deepest of free points (N, 3), metres, at least the resolution."""
    deepest: FloatArray = -signed_distances(sdf, poses, points=free).min(axis=1, initial=np.inf)
    return np.maximum(deepest, sdf.resolution)


def heights(sdf: SdfGrid, poses: Poses, *, floor: float) -> FloatArray:
    """Return heights (B,) of the object's lowest point above the floor in each pose, metres."""
    lowest: FloatArray = outline_in_world(sdf, poses)[..., 2].min(axis=1) - floor
    return lowest


class _Gains(NamedTuple):
    """Arrays of A actions that the kernel fills."""

    information: FloatArray  # (A,), nats
    # (A,), metres: root mean square distance of the surface in the pose that shows the outcome
    # from that in a pose drawn from what is left of the belief after it
    expected_spread: FloatArray
    loss: FloatArray  # (A,), metres: the mean of the same distance, for its root mean square
    surviving: FloatArray  # (A,): expected weight of the poses that the outcome does not rule out


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecasts of all A actions of a decision, by its belief of K poses.

    noise: standard deviation of a contact's place from where it is forecast, metres.
    """

    problem: DecisionProblem  # the decision
    noise: float  # metres

    @cached_property
    def first(self) -> FirstContacts:
        """The first contacts of each action, by pose."""
        of = self.problem
        return first_contacts(of.sdf, of.belief, actions=of.actions, hand=of.hand)

    @cached_property
    def normals(self) -> ContactNormals:
        """The normals at the first contacts; empty if no known contact has a normal.

        The noise of the next one is the median noise of those.
        """
        of = self.problem
        if not of.points.has_normals:
            return _NO_NORMALS
        noise = of.points.normal_noise
        variance = 0.5 * float(np.median(noise[noise > 0.0])) ** 2 + FACET**2
        return contact_normals(of.sdf, of.belief, first=self.first, variance=variance)

    @property
    def hit(self) -> BoolArray:
        """Whether an action meets the object (K, A), by pose."""
        return self.first.travel < inf

    @cached_property
    def hit_chance(self) -> FloatArray:
        """That the hand meets the object (A,)."""
        return self._chance(self.hit)

    @cached_property
    def blocked_chance(self) -> FloatArray:
        """That the object is in the way to the start (A,)."""
        return self._chance(self.first.travel < 0.0)

    @cached_property
    def distances(self) -> FloatArray:
        """Distances (K, K) of the surfaces in poses from each other, metres."""
        poses = Poses.of(self.problem.belief.object_from_world)
        return distances_apart(self.problem.sdf, poses)

    @cached_property
    def spread(self) -> float:
        """Root mean square distance of two surfaces drawn from the belief, metres."""
        return surface_spread(self.distances, self.problem.belief.weights)

    @cached_property
    def gains(self) -> _Gains:
        """The gains of each action."""
        count = len(self.problem.actions)
        gains = _Gains(
            np.zeros(count), np.empty(count), loss=np.empty(count), surviving=np.ones(count)
        )
        weights = np.array(self.problem.belief.weights)
        distances = self.distances
        contacts = self.first  # before threads begin, which must not wait for each other
        normals = self.normals
        met = self.hit.any(axis=0)
        missed = np.flatnonzero(~met)  # in every pose: their gains are those of the first
        which = np.concatenate([np.flatnonzero(met), missed[:1]])

        def run(first: int, last: int, lanes: FloatArray) -> None:
            some = which[first:last]
            overlap(contacts, normals, weights, distances, self.noise, gains, lanes, some)

        size = (len(weights) + 1) * _SIZE
        parallel_for(run, len(which), scratch=lambda: scratch(size), least=LANES, multiple=LANES)
        for values in gains:
            values[missed] = values[missed[:1]]
        return gains

    def _chance(self, flags: BoolArray) -> FloatArray:
        """Return weight (A,) of the poses with a flag, of flags (K, A)."""
        return in_order(np.where(flags, self.problem.belief.weights[:, None], 0.0).T)


@compiled
def overlap(
    first: Any,
    normals: Any,
    weights: Any,
    distances: Any,
    noise: Any,
    gains: Any,
    lanes: Any,
    which: Any,
) -> None:
    """Fill `gains` of some actions (C,), indices, from how alike their outcomes are.

    Outcomes of two poses overlap by the Bhattacharyya coefficient of Gaussians around their
    contacts, B = exp(-d^2 / 8 noise^2), times that of their normals, if these are forecast; by 1 if
    both miss, and hardly if one does. A pose survives another's outcome with likelihood B^2.
    Information is the pairwise bound of Kolchinsky and Tracey (Entropy, 2017),
    - sum_i w_i ln sum_j w_j B_ij.
    lanes: scratch ((K + 1) _SIZE,), for each pose the rows of _X and so on, a number for each of
    LANES actions, then a row of overlaps.
    """
    for begin in range(0, len(which), LANES):
        end = min(begin + LANES, len(which))
        some = which[begin:end]
        _place_contacts(first, weights, lanes, some)
        _add_overlaps(normals, weights, distances, 1.0 / (8.0 * noise * noise), lanes, some)
        for lane in range(end - begin):
            _sum_gains(weights, lanes, lane, gains, some[lane])


@inner
def _place_contacts(first: Any, weights: Any, lanes: Any, some: Any) -> None:
    """Fill the rows of poses: contacts of some actions, and sums that have each pose alone."""
    for i in range(len(weights)):
        for lane in range(LANES):
            at = np.uint64(i * _SIZE + lane)
            a = some[min(lane, len(some) - 1)]  # lanes that are left over repeat the last action
            lanes[at + _X] = first.contact[i, a, 0]
            lanes[at + _Y] = first.contact[i, a, 1]
            lanes[at + _Z] = first.contact[i, a, 2]
            lanes[at + _HIT] = 1.0 if first.travel[i, a] < np.inf else 0.0
            lanes[at + _ALIKE] = weights[i]
            lanes[at + _ALIVE] = weights[i]
            lanes[at + _FAR] = 0.0
            lanes[at + _FARTHER] = 0.0


@inner
def _add_overlaps(
    normals: Any, weights: Any, distances: Any, scale: Any, lanes: Any, some: Any
) -> None:
    """Add the overlaps of all pairs of poses to their sums; vectorised.

    A loop for each sum, as the compiler makes no vector instructions of all in one.
    """
    count = len(weights)
    with_normals = len(normals.variances) > 0
    size = np.uint64(_SIZE)
    overlaps = np.uint64(count) * size
    for i in range(count):
        one = np.uint64(i) * size
        for j in range(i + 1, count):
            other = np.uint64(j) * size
            for lane in range(LANES):
                n = np.uint64(lane)
                x = lanes[one + _X + n] - lanes[other + _X + n]
                y = lanes[one + _Y + n] - lanes[other + _Y + n]
                z = lanes[one + _Z + n] - lanes[other + _Z + n]
                exponent = scale * (x * x + y * y + z * z)
                near = exp_in_lanes(-min(exponent, _FARTHEST))
                near = near if exponent <= _FARTHEST else 0.0
                hits = lanes[one + _HIT + n] + lanes[other + _HIT + n]
                lanes[overlaps + n] = near if hits == 2.0 else (_UNLIKE if hits == 1.0 else 1.0)
            if with_normals:
                for lane in range(len(some)):
                    n = np.uint64(lane)
                    if lanes[one + _HIT + n] + lanes[other + _HIT + n] == 2.0:
                        lanes[overlaps + n] *= _normals_overlap(normals, i, j, some[lane])
            u, v, d = weights[i], weights[j], distances[i, j]
            for lane in range(LANES):
                n = np.uint64(lane)
                b = lanes[overlaps + n]
                lanes[one + _ALIKE + n] += v * b
                lanes[other + _ALIKE + n] += u * b
            for lane in range(LANES):
                n = np.uint64(lane)
                g = lanes[overlaps + n] * lanes[overlaps + n]
                lanes[one + _ALIVE + n] += v * g
                lanes[other + _ALIVE + n] += u * g
            for lane in range(LANES):
                n = np.uint64(lane)
                g = lanes[overlaps + n] * lanes[overlaps + n]
                lanes[one + _FAR + n] += v * g * d
                lanes[other + _FAR + n] += u * g * d
            for lane in range(LANES):
                n = np.uint64(lane)
                g = lanes[overlaps + n] * lanes[overlaps + n]
                lanes[one + _FARTHER + n] += v * g * d * d
                lanes[other + _FARTHER + n] += u * g * d * d


@inner
def _sum_gains(weights: Any, lanes: Any, lane: Any, gains: Any, a: Any) -> None:
    """Fill the gains of an action from the sums in its lane."""
    information = 0.0
    left = 0.0
    loss = 0.0
    surviving = 0.0
    for i in range(len(weights)):
        if weights[i] > 0.0:
            at = np.uint64(i * _SIZE + lane)
            alive = lanes[at + _ALIVE]
            information -= weights[i] * log(lanes[at + _ALIKE])
            left += weights[i] * lanes[at + _FARTHER] / alive
            loss += weights[i] * lanes[at + _FAR] / alive
            surviving += weights[i] * alive
    gains.information[a] = max(information, 0.0)
    gains.expected_spread[a] = np.sqrt(left)
    gains.loss[a] = loss
    gains.surviving[a] = surviving


@leaf
def _normals_overlap(normals: Any, i: Any, j: Any, a: Any) -> Any:
    """Return the overlap of the normals that poses i and j forecast of action a.

        N = (1 - q) exp(-(1 - cos) / 2 (v_i + v_j)) + q

    The first term is the Bhattacharyya coefficient of Gaussians of the mean of both variances v, at
    an angle whose square is 2 (1 - cos). A share q of normals is wrong, in any direction, whatever
    the pose; as it is part of both outcomes, N is a lower bound on the coefficient of the mixtures.
    """
    cosine = 0.0
    for axis in range(3):
        cosine += normals.normals[i, a, axis] * normals.normals[j, a, axis]
    exponent = 0.5 * max(1.0 - cosine, 0.0) / (normals.variances[i, a] + normals.variances[j, a])
    return (1.0 - WRONG_NORMALS) * exp(-exponent) + WRONG_NORMALS


@dataclass(frozen=True)
class SurpriseSettings(CheckedSettings):
    """The response to an outcome that no pose of the belief has forecast."""

    # Above so many nats the next registration starts afresh, with so many times the hypotheses.
    limit: Annotated[float, not_negative] = 6.0
    larger: Annotated[int, positive, at_most(100)] = 3  # factor of the hypotheses


def surprise(
    problem: DecisionProblem, decision: Decision, *, noise: float, contact: FloatArray | None
) -> float:
    """Return -ln of the chance that was forecast for the outcome of the chosen action, nats.

    contact (3,): where the hand has met the object, world frame, metres; None if it has not.
    noise: of contacts, metres. Places within the scatter of the forecast contacts, and within the
    noise, are as likely as each other; the chance of a place farther off falls like a Gaussian. 6.5
    is the most: no pose had forecast anything like it.
    """
    weights = problem.belief.weights
    forecast = decision.contacts
    hits = ~np.isnan(forecast[:, 0])
    places = np.where(hits[:, None], forecast, 0.0)
    hit = float(in_order(np.where(hits, weights, 0.0)))
    scatter = 0.0
    if hit > 0.0:
        away = places - in_order(weights * places.T) / hit
        scatter = float(in_order(np.where(hits, weights / hit * in_order(away * away), 0.0)))
    scale = 1.0 / (4.0 * noise * noise + scatter)
    likely = np.where(hits, _WRONG, 1.0)
    if contact is not None:
        away = places - contact
        near = np.maximum(_WRONG, exps(-scale * in_order(away * away)))
        likely = np.where(hits, near, _WRONG)
    chance = float(in_order(weights * likely))
    return -float(logs((1.0 - _NONE_OF_THESE) * chance + _NONE_OF_THESE * _ANY_OUTCOME))
