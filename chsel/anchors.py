"""Poses that put points of an object's surface onto contacts, and the best of many such."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.coarse_score import coarse_of
from chsel.errors import SettingError, require_positive
from chsel.far_apart import far_apart
from chsel.kernels.anchors import DRAWS, Anchors, Best, best_for, sample
from chsel.points import KnownPoints
from chsel.problem import RegistrationProblem
from chsel.sdf import SdfGrid
from chsel.space import SE2Space, SearchSpace
from chsel.streams import Purpose, StreamKey
from chsel.surface import surface_points
from chsel.threads import spread

SURFACE_POINTS = 400
MOST_ANCHORS = 48
_TELLING = 64  # known points that are put in order
_BLOCK = 65_536  # poses that are drawn at a time
_SAMPLES_PER_THREAD = 5_000
_LENGTHS_ALIKE = 0.004  # metres
_LEAST_LENGTH = 0.01  # metres between two contacts that tell a direction


@dataclass(frozen=True)
class AnchorSettings:
    """How poses are drawn.

    pairs: the share that puts two surface points onto the line of two contacts. contacts: the share
    that puts one onto one. The rest is uniform in the workspace and SO(3). margin: metres by which
    the workspace is widened for the object's origin.
    """

    pairs: float = 0.5
    contacts: float = 0.4
    margin: float = 0.15

    def __post_init__(self) -> None:
        for name in ("pairs", "contacts", "margin"):
            require_positive(name, getattr(self, name), zero=True)
        if self.pairs + self.contacts > 1.0:
            raise SettingError(
                f"pairs and contacts are {self.pairs} and {self.contacts}; accepted: shares whose "
                "sum is at most 1"
            )


def anchored_poses(
    problem: RegistrationProblem,
    known: KnownPoints,
    space: SearchSpace,
    settings: AnchorSettings,
    *,
    samples: int,
    most: int,
    index: int = 0,
) -> FloatArray:
    """The best of so many random poses by their coarse score: poses (K, 12), best first.

    known: the problem's points, see `in_telling_order`. most: K at most; less where the object
    is out of its bounds too often. index: of the stream.
    """
    margin = settings.margin
    anchors = _anchors(problem, known, space, settings)
    coarse = coarse_of(problem, known, margin)
    stream = problem.key.stream(Purpose.ANCHORS, index)
    made: list[Best] = []

    def scratch() -> Best:
        made.append(best_for(most))
        return made[-1]

    def run(first: int, last: int, best: Best) -> None:
        sample(coarse, space.arrays, anchors, draws, before, first, last, best)

    for before in range(0, samples, _BLOCK):
        draws = stream.random((min(_BLOCK, samples - before), DRAWS), dtype=np.float32)
        spread(run, len(draws), scratch, least=_SAMPLES_PER_THREAD)
    counts = [int(best.state[0]) for best in made]
    parts = list(zip(made, counts, strict=True))
    scores = np.concatenate([best.scores[:count] for best, count in parts])
    numbers = np.concatenate([best.numbers[:count] for best, count in parts])
    poses = np.concatenate([best.poses[:count] for best, count in parts])
    return poses[np.lexsort([numbers, scores])[:most]]


def in_telling_order(points: KnownPoints) -> KnownPoints:
    """The points, with known ones in the order in which they tell most: each far from the others.

    So poses that do not fit are found out early.
    """
    first = far_apart(points.known, _TELLING)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(points.known)), first)])
    return replace(points, known=points.known[order], known_sdf=points.sdf[order])


def bounds_of(
    problem: RegistrationProblem, space: SearchSpace, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Where the object's origin may be (3,): the workspace, widened by a margin in metres.

    And by as much as it takes to meet the plane, if the object is on one.
    """
    lower, upper = problem.workspace.bounds
    if isinstance(space, SE2Space):
        upward = _upward(space)
        corners = np.where(upward > 0.0, lower, upper), np.where(upward > 0.0, upper, lower)
        lowest, highest = (float((corner * upward).sum()) for corner in corners)
        margin += max(lowest + space.offset, -space.offset - highest, 0.0)
    return lower - margin, upper + margin


def _upward(space: SE2Space) -> FloatArray:
    """The plane's axis in the world (3,): R^T a is the same for every pose."""
    upward: FloatArray = (space.resting_rotation * space.axis[:, None]).sum(axis=0)
    return upward


def _anchors(
    problem: RegistrationProblem, known: KnownPoints, space: SearchSpace, settings: AnchorSettings
) -> Anchors:
    """What can be put onto what."""
    sdf = problem.sdf
    surface, normals, lengths, by_distance = sdf.derived("anchors", lambda: _pairs_of(sdf))
    contacts, values = known.known[:MOST_ANCHORS], known.sdf[:MOST_ANCHORS]
    allowed = np.arange(len(surface))
    pairs = np.zeros((0, 4), dtype=np.int64)
    if isinstance(space, SE2Space):
        allowed, singles = _at_heights(space, surface, contacts, values)
    else:
        whole = np.full(len(contacts), len(surface))
        singles = np.stack([np.arange(len(contacts)), 0 * whole, whole], axis=1)
        pairs = _matching(contacts, values, lengths)
    return Anchors(
        contacts.T.copy(),
        values.copy(),
        surface.T.copy(),
        normals.T.copy(),
        by_distance,
        pairs,
        singles,
        allowed,
        np.array([settings.pairs if len(pairs) else 0.0, settings.pairs + settings.contacts]),
        *bounds_of(problem, space, settings.margin),
    )


def _pairs_of(sdf: SdfGrid) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Surface points and normals (Q, 3), and pairs (P, 2) of them in the order of lengths (P,)."""
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    surface = surface_points(sdf, SURFACE_POINTS, stream)
    normals = sdf.query(surface, lookup="trilinear")[1].numpy()
    normals = normals / np.maximum(np.sqrt((normals**2).sum(axis=1, keepdims=True)), 1e-12)
    i, j = np.triu_indices(len(surface), 1)
    lengths = np.sqrt(((surface[i] - surface[j]) ** 2).sum(axis=1))
    order = np.argsort(lengths, kind="stable")
    return surface, normals, lengths[order], np.stack([i, j], axis=1)[order]


def _matching(contacts: FloatArray, values: FloatArray, lengths: FloatArray) -> IntArray:
    """Pairs of contacts with the range of surface pairs of their length (C, 4)."""
    touching = np.flatnonzero(values == 0.0)
    i, j = (touching[part] for part in np.triu_indices(len(touching), 1))
    apart = np.sqrt(((contacts[i] - contacts[j]) ** 2).sum(axis=1))
    first = np.searchsorted(lengths, apart - _LENGTHS_ALIKE)
    last = np.searchsorted(lengths, apart + _LENGTHS_ALIKE, side="right")
    good = (apart >= _LEAST_LENGTH) & (last > first)
    return np.stack([i, j, first, last], axis=1)[good].astype(np.int64)


def _at_heights(
    space: SE2Space,
    surface: FloatArray,
    contacts: FloatArray,
    values: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Surface points in the order of their heights, and of each contact those that can meet it."""
    heights = (surface * space.axis).sum(axis=1)
    order = np.argsort(heights, kind="stable")
    wanted = (contacts * _upward(space)).sum(axis=1) + space.offset
    reach = _LENGTHS_ALIKE + np.abs(values)
    first = np.searchsorted(heights[order], wanted - reach)
    last = np.searchsorted(heights[order], wanted + reach, side="right")
    singles = np.stack([np.arange(len(contacts)), first, last], axis=1)
    return order, singles[last > first]
