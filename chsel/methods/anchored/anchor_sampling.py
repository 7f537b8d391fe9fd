"""Poses that put the object's surface onto contacts, as starts beside E_0 (Alg. 1, line 1)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from chsel.errors import SettingError
from chsel.methods.anchored.coarse_score import coarse_of, in_32_bits
from chsel.methods.anchored.placing_kernels import Anchors
from chsel.methods.anchored.sampling_kernels import Best, best_for, grades, sample
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.threads import spread
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, rotated
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space, SE3Space, SearchSpace, origin_bounds
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points
from chsel.problem.surface import has_surface, surface_points

SURFACE_POINTS = 400
MOST_ANCHORS = 48  # contacts that the surface is put onto
MOST_SAMPLES = 100_000_000
MOST_KEPT = 100_000
_MOST_ORDERED = 64  # known points that are put in order
_SAMPLES_PER_THREAD = 5_000
_LENGTHS_ALIKE = 0.004  # metres
_ROUNDING = 2e-6  # of coordinates in 32 bits, generously
_LEAST_LENGTH = 0.01  # metres between two contacts that give a direction


@dataclass(frozen=True)
class AnchorSettings(CheckedSettings):
    """How poses are drawn: on pairs of contacts, on single ones, or uniform in the workspace."""

    pairs: Annotated[float, not_negative] = 0.5  # share with two surface points on a pair's line
    contacts: Annotated[float, not_negative] = 0.4  # share with one surface point on a contact
    margin: Annotated[float, not_negative] = 0.15  # of the workspace for object origins, metres

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pairs + self.contacts > 1.0:
            raise SettingError(
                f"pairs and contacts are {self.pairs} and {self.contacts}; accepted: shares whose "
                "sum is at most 1"
            )


class AnchorSampler:
    """Draws poses for one problem."""

    def __init__(
        self,
        problem: RegistrationProblem,
        known: KnownPoints,
        space: SearchSpace,
        settings: AnchorSettings,
    ) -> None:
        """known: the problem's points, see most_informative_first."""
        self._problem, self._known, self._space, self._settings = problem, known, space, settings
        lower, upper = problem.workspace.bounds
        middle = 0.5 * (lower + upper)
        if len(known.known):  # the median of contacts, so that 32 bits are enough around it
            median = np.sort(known.known, axis=0)[len(known.known) // 2]
            middle = np.minimum(np.maximum(median, lower), upper)
        self._middle = middle
        self._anchors = _anchors(problem, known, space, settings, middle)

    def best(self, samples: int, most: int, *, index: int = 0, tolerance: float = 0.0) -> Poses:
        """The best of so many random poses by their coarse score: K poses, best first.

        most: K at most; fewer where the object is out of its bounds too often. index: of the
        stream. tolerance: see coarse_of.
        """
        coarse = coarse_of(
            self._problem, self._known, self._middle, self._settings.margin, tolerance
        )
        anchors = self._placed(samples)
        stream = self._problem.key.kernel_stream(Purpose.ANCHORS, index)
        bests: list[Best] = []
        shared = grades()

        def scratch() -> Best:
            best = best_for(min(most, samples), shared)
            bests.append(best)  # another thread may append its own before this one goes on
            return best

        def run(first: int, last: int, best: Best) -> None:
            sample(coarse, anchors, stream, samples, first, last, best)

        spread(run, samples, scratch, least=_SAMPLES_PER_THREAD)
        keys = np.concatenate([best.keys[: best.size[0]] for best in bests])
        poses = np.concatenate([best.poses[best.slots[: best.size[0]]] for best in bests])
        return self._exact(poses[np.argsort(keys)[:most]].astype(np.float64))

    def _placed(self, samples: int) -> Anchors:
        """The anchors, with how many poses are placed by them."""
        settings, anchors = self._settings, self._anchors
        pairs = round(settings.pairs * samples) if len(anchors.frames) else 0
        anchored = round((settings.pairs + settings.contacts) * samples)
        return anchors._replace(kinds=(pairs, anchored if len(anchors.singles) else pairs))

    def _exact(self, numbers: FloatArray) -> Poses:
        """Poses in the world from those (K, 12) that kernels found around its middle."""
        rigid = SE3Space()
        turned = rigid.poses(rigid.encode(Poses(numbers)))
        shift = turned.translations - rotated(turned.rotations, self._middle)
        poses = Poses(np.concatenate([turned.numbers[:, :9], shift], axis=1))
        return self._space.poses(self._space.encode(poses))


def most_informative_first(points: KnownPoints) -> KnownPoints:
    """The points, with known ones in the order of farthest points.

    So sums over them rule out poses that do not fit after a few.
    """
    first = farthest_points(points.known, _MOST_ORDERED)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(points.known)), first)])
    return replace(points, known=points.known[order], known_sdf=points.sdf[order])


def _anchors(
    problem: RegistrationProblem,
    known: KnownPoints,
    space: SearchSpace,
    settings: AnchorSettings,
    middle: FloatArray,
) -> Anchors:
    sdf = problem.sdf
    surface, normals, lengths, by_distance = sdf.derived("anchors", lambda: _pairs_of(sdf))
    contacts, values = known.known[:MOST_ANCHORS], known.sdf[:MOST_ANCHORS]
    if isinstance(space, SE2Space):
        by_height, met, single_spans = _at_heights(space, surface, contacts, values)
        pairs = pair_spans = np.zeros((0, 2), dtype=np.int64)
        offset = space.offset + float((space.upward * middle).sum())
        turns = [space.arrays.resting, space.arrays.turning, space.arrays.turning_squared]
        plane = np.concatenate([space.axis, [offset], *turns])
    else:
        by_height, met = np.arange(len(surface)), np.arange(len(contacts))
        single_spans = np.tile([0, len(surface)], (len(contacts), 1))
        pairs, pair_spans = _matching(contacts, values, lengths)
        plane = np.zeros(0)
    lower, upper = origin_bounds(problem.workspace, space, settings.margin)
    inset = _ROUNDING * (1.0 + np.abs([lower - middle, upper - middle]).max(axis=0))
    inset = np.minimum(inset, 0.25 * (upper - lower))
    bounds = in_32_bits(np.stack([lower + inset, upper - inset]) - middle)
    return Anchors(
        kinds=(0, 0),
        surface=in_32_bits(surface),
        normals=in_32_bits(normals),
        by_distance=by_distance.astype(np.int16),
        frames=in_32_bits(_frames(contacts[pairs] - middle)),
        pair_spans=pair_spans.astype(np.int32),
        singles=in_32_bits(np.concatenate([contacts - middle, values[:, None]], axis=1)[met]),
        single_spans=single_spans.astype(np.int32),
        by_height=by_height.astype(np.int16),
        lower=bounds[0],
        upper=bounds[1],
        planar=isinstance(space, SE2Space),
        plane=in_32_bits(plane),
    )


def _frames(pairs: FloatArray) -> FloatArray:
    """Of pairs of points (C, 2, 3): a frame along their line, row by row, then their middle."""
    along = pairs[:, 1] - pairs[:, 0]
    along = along / np.sqrt((along**2).sum(axis=1, keepdims=True))
    axis = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    across = np.cross(along, axis)
    across = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    middle = 0.5 * (pairs[:, 0] + pairs[:, 1])
    return np.concatenate([along, across, np.cross(along, across), middle], axis=1)


def _pairs_of(sdf: SdfGrid) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Surface points and normals (Q, 3), and pairs (P, 2) of them in the order of lengths (P,)."""
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    surface = surface_points(sdf, SURFACE_POINTS, stream)
    normals = sdf.at(surface, lookup="trilinear")[1]
    normals = normals / np.maximum(np.sqrt((normals**2).sum(axis=1, keepdims=True)), 1e-12)
    i, j = np.triu_indices(len(surface), 1)
    lengths = np.sqrt(((surface[i] - surface[j]) ** 2).sum(axis=1))
    order = np.argsort(lengths, kind="stable")
    return surface, normals, lengths[order], np.stack([i, j], axis=1)[order]


def _matching(
    contacts: FloatArray, values: FloatArray, lengths: FloatArray
) -> tuple[IntArray, IntArray]:
    """Pairs of contacts (C, 2), and the spans (C, 2) of surface pairs of their length."""
    touching = np.flatnonzero(values == 0.0)
    pairs = touching[np.stack(np.triu_indices(len(touching), 1), axis=1)]
    apart = np.sqrt(((contacts[pairs[:, 0]] - contacts[pairs[:, 1]]) ** 2).sum(axis=1))
    spans = _spans(lengths, apart, _LENGTHS_ALIKE)
    good = (apart >= _LEAST_LENGTH) & (spans[:, 1] > 0)
    return pairs[good], spans[good]


def _at_heights(
    space: SE2Space, surface: FloatArray, contacts: FloatArray, values: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Surface points in the order of their heights, and the contacts that some can meet.

    With the spans (S, 2) of these points.
    """
    heights = (surface * space.axis).sum(axis=1)
    order = np.argsort(heights, kind="stable")
    wanted = (contacts * space.upward).sum(axis=1) + space.offset
    spans = _spans(heights[order], wanted, _LENGTHS_ALIKE + np.abs(values))
    met = np.flatnonzero(spans[:, 1] > 0)
    return order, met, spans[met]


def _spans(ascending: FloatArray, wanted: FloatArray, reach: FloatArray | float) -> IntArray:
    """First, and how many (N, 2) of the ascending values are near to wanted ones (N,)."""
    first = np.searchsorted(ascending, wanted - reach)
    last = np.searchsorted(ascending, wanted + reach, side="right")
    return np.stack([first, last - first], axis=1)


@dataclass(frozen=True)
class AnchoredStarts(CheckedSettings):
    """How many poses on contacts CHSEL descends from, beside E_0."""

    samples: Annotated[int, positive, at_most(MOST_SAMPLES)] = 20_000  # poses that are drawn
    kept: Annotated[int, positive, at_most(MOST_KEPT)] = 60  # those of them that score best
    anchors: AnchorSettings = field(default_factory=AnchorSettings)


def anchored_starts(
    problem: RegistrationProblem, space: SearchSpace, settings: AnchoredStarts, index: int
) -> Poses:
    """K poses, best first; none of an object too thin to have a surface on its grid.

    index: of the pass, each of which draws its own.
    """
    if not has_surface(problem.sdf):
        return Poses(np.zeros((0, 12)))
    sampler = AnchorSampler(
        problem, most_informative_first(problem.points), space, settings.anchors
    )
    return sampler.best(settings.samples, settings.kept, index=index)
