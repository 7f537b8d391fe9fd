"""Poses that put the object's surface onto contacts, as starts beside E_0 (Alg. 1, line 1)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.methods.coarse_score import (
    SAMPLES,
    Found,
    coarse_score,
    cost_of_first,
    free_voxels,
    score_below,
)
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import sine_cosine_of_share
from chsel.numerics.pose_tuples import (
    SpaceConstants,
    Triple,
    planar_pose,
)
from chsel.numerics.threads import parallel_for
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space, SearchSpace, origin_bounds
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.streams import Purpose, StreamKey, uniforms_of_block
from chsel.problem.subset import farthest_points
from chsel.problem.surface import has_surface, surface_points

_MOST_SAMPLES = 100_000_000
_MOST_KEPT = 100_000
_SURFACE_POINTS = 400  # of which 80 000 pairs are of all lengths
_MOST_ANCHORS = 48  # contacts that the surface is put onto: more are close to these
_MOST_ORDERED = 64  # known points that are put in order: no fewer than anchors, or score poses
_SAMPLES_PER_THREAD = 5_000  # fewer take less time than to wake another thread
_LENGTHS_ALIKE = 0.004  # metres, about half of the distance between surface points
_LEAST_LENGTH = 0.01  # metres between two contacts that give a direction
_FAR = 0.6  # from an axis: more than 1 / sqrt(3), so that any direction is far from one
_SHORTEST_SQUARED = 1e-9  # metres^2, of lines between surface points
_TURN = 2.0 * np.pi
# Samples are placed in blocks, for vector instructions. A block has a row for each number of its
# samples; poses are in the first rows, as `cost_of_first` reads them.
_MOST = SAMPLES
_ROTATION = 0  # the first of 9 rows: of rotations
_SHIFT = 9 * _MOST  # of 3: of translations
_POINT = 12 * _MOST  # of 3: of the world
_ONTO = 15 * _MOST  # of 3: of the object, onto which the former is moved
_OTHER = 18 * _MOST  # of 3: the other point of a pair
_FRAME = 21 * _MOST  # of 9: the axes of a pair of contacts
_SHARE = 30 * _MOST  # of 3: random numbers of a rotation
_WITHIN = 33 * _MOST  # whether the object is in its bounds, 1 or 0
_SIZE = 34 * _MOST


@dataclass(frozen=True)
class AnchorSettings(CheckedSettings):
    """Shares of poses drawn on pairs of contacts, on single ones, and uniform in the workspace."""

    pairs: Annotated[float, not_negative] = 0.5  # share with two surface points on a pair's line
    contacts: Annotated[float, not_negative] = 0.4  # share with one surface point on a contact
    margin: Annotated[float, not_negative] = 0.15  # of the workspace for object origins, metres


@dataclass(frozen=True)
class AnchoredStarts(CheckedSettings):
    """The number of poses on contacts that CHSEL descends from, beside E_0."""

    samples: Annotated[int, positive, at_most(_MOST_SAMPLES)] = 20_000  # poses that are drawn
    kept: Annotated[int, positive, at_most(_MOST_KEPT)] = 60  # those of them that score best
    anchors: AnchorSettings = field(default_factory=AnchorSettings)  # where they are drawn


def anchored_starts(
    problem: RegistrationProblem, space: SearchSpace, *, settings: AnchoredStarts, index: int
) -> Poses:
    """Return K poses, best first; none of an object too thin to have a surface on its grid.

    index: of the pass, each of which draws its own.
    """
    if not has_surface(problem.sdf):
        return Poses(np.zeros((0, 12)))
    points = problem.points.without_normals()  # as the method reads neither them nor a prior
    problem = replace(problem, points=points, prior=None)
    known = most_informative_first(points)
    sampler = AnchorSampler(problem, known, space=space, settings=settings.anchors)
    return sampler.best(settings.samples, settings.kept, index=index)


def most_informative_first(points: KnownPoints) -> KnownPoints:
    """Return the points, with known ones in the order of farthest points.

    So sums over them rule out poses that do not fit after a few.
    """
    first = farthest_points(points.known, _MOST_ORDERED)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(points.known)), first)])
    return points.with_known(order)


class AnchorSampler:
    """Draws poses for one problem."""

    def __init__(
        self,
        problem: RegistrationProblem,
        known: KnownPoints,
        *,
        space: SearchSpace,
        settings: AnchorSettings,
    ) -> None:
        """known: the problem's points, see most_informative_first."""
        self._problem = problem
        self._known = known
        self._settings = settings
        self._free = free_voxels(problem, settings.margin)
        bounds = origin_bounds(problem.workspace, space, margin=settings.margin)
        self._anchors = anchors_of(problem.sdf, known, space=space, bounds=bounds)

    def best(
        self, samples: int, most: int, *, index: int = 0, tolerance: float = 0.0, left_out: int = 0
    ) -> Poses:
        """Return the best of so many random poses by their coarse score: K poses, best first.

        The score is the mean distance of contacts, and depths of points inside in free space. Of
        equal scores the first is better, so that the result does not depend on threads.
        most: K at most; fewer where the object is out of its bounds too often. index: of the
        stream. tolerance: see `coarse_score`. left_out: 1 for scores without the contact that costs
        a pose the most, as it may be a contact with another object; else 0.
        """
        score = coarse_score(
            self._problem, self._known, free=self._free, tolerance=tolerance, left_out=left_out
        )
        anchors = self._anchors
        settings = self._settings
        pairs = round(settings.pairs * samples) if len(anchors.pair_frames) else 0
        anchored = round((settings.pairs + settings.contacts) * samples)
        if anchors.contacts.shape[1] == 0:
            anchored = pairs
        stream = self._problem.key.kernel_stream(Purpose.ANCHORS, index)
        most = min(most, samples)
        heaps: list[BestPoses] = []

        def new_heap() -> BestPoses:
            heap = BestPoses(
                np.full(most, np.inf), np.full(most, -1, dtype=np.int64), poses=np.zeros((most, 12))
            )
            heaps.append(heap)  # another thread may append its own before this one goes on
            return heap

        def run(first: int, last: int, heap: Any) -> None:
            keep_best(score, anchors, stream, pairs, anchored, first, last, heap)

        parallel_for(run, samples, scratch=new_heap, least=_SAMPLES_PER_THREAD)
        scores = np.concatenate([heap.scores for heap in heaps])
        numbers = np.concatenate([heap.numbers for heap in heaps])
        order = np.lexsort([numbers, scores])
        order = order[numbers[order] >= 0][:most]
        return Poses(np.concatenate([heap.poses for heap in heaps])[order])


class Anchors(NamedTuple):
    """Contacts, and the surface points that can be put onto them, as kernels read them."""

    space: SpaceConstants
    lower: Triple  # where the object's origin may be, world, metres
    upper: Triple  # the other corner
    surface: FloatArray  # (3, Q), object frame, metres
    normals: FloatArray  # (3, Q)
    surface_pairs: IntArray  # (2 P,), two surface points each, ascending by their distance
    surface_order: IntArray  # (Q,), surface points by their heights over a plane
    contacts: FloatArray  # (3, C), world, metres
    values: FloatArray  # (C,), their signed distances, metres
    contact_spans: IntArray  # (C, 2), which of the ordered surface points: the first, how many
    pair_spans: IntArray  # (D, 2), of pairs of contacts: which pairs of surface points
    pair_frames: FloatArray  # (D, 12), axes, the first along the pair, and its middle, world


def anchors_of(
    sdf: SdfGrid,
    known: KnownPoints,
    *,
    space: SearchSpace,
    bounds: tuple[FloatArray, FloatArray],
) -> Anchors:
    """Return the anchors of an object among known points, whose origin may be within bounds."""
    surface, normals, lengths, pairs = sdf.derived("surface pairs", lambda: _surface_pairs(sdf))
    contacts, values = known.known[:_MOST_ANCHORS], known.sdf[:_MOST_ANCHORS]
    order = np.arange(len(surface))
    contact_pairs = np.zeros((0, 2), dtype=np.int64)
    if isinstance(space, SE2Space):
        heights = (surface * space.axis).sum(axis=1)
        order = np.argsort(heights, kind="stable")
        wanted = (contacts * space.upward).sum(axis=1) + space.offset
        spans = _spans(heights[order], wanted, reach=_LENGTHS_ALIKE + np.abs(values))
        pair_spans = contact_pairs
    else:
        spans = np.tile([0, len(surface)], (len(contacts), 1))
        contact_pairs, pair_spans = _pairs_of_contacts(contacts, values, lengths=lengths)
    met = spans[:, 1] > 0
    return Anchors(
        space=space.arrays,
        lower=triple(bounds[0]),
        upper=triple(bounds[1]),
        surface=surface.T.copy(),
        normals=normals.T.copy(),
        surface_pairs=pairs,
        surface_order=order,
        contacts=contacts[met].T.copy(),
        values=values[met],
        contact_spans=spans[met],
        pair_spans=pair_spans,
        pair_frames=_frames(contacts[contact_pairs]),
    )


class BestPoses(NamedTuple):
    """The K best poses so far, a heap whose first is the worst: by scores, then by numbers."""

    scores: FloatArray  # (K,), infinite where there is none
    numbers: IntArray  # (K,), of samples; -1 where there is none
    poses: FloatArray  # (K, 12)


def _frames(pairs: FloatArray) -> FloatArray:
    """Return frames (C, 12) of pairs of points (C, 2, 3): axes, the first along, then middle."""
    along = pairs[:, 1] - pairs[:, 0]
    along = along / np.sqrt((along**2).sum(axis=1, keepdims=True))
    axis = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    across = np.cross(along, axis)
    across = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    middle = 0.5 * (pairs[:, 0] + pairs[:, 1])
    return np.concatenate([along, across, np.cross(along, across), middle], axis=1)


def _surface_pairs(sdf: SdfGrid) -> tuple[FloatArray, FloatArray, FloatArray, Any]:
    """Return surface points and normals (Q, 3), pairs (2 P,) of them, and their lengths (P,)."""
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    surface = surface_points(sdf, _SURFACE_POINTS, stream=stream)
    normals = sdf.at(surface, lookup="trilinear")[1]
    normals = normals / np.maximum(np.sqrt((normals**2).sum(axis=1, keepdims=True)), 1e-12)
    i, j = np.triu_indices(len(surface), 1)
    lengths = np.sqrt(((surface[i] - surface[j]) ** 2).sum(axis=1))
    order = np.argsort(lengths, kind="stable")
    pairs = np.stack([i, j], axis=1)[order].astype(np.int16)
    return surface, normals, lengths[order], pairs.reshape(-1)


def _pairs_of_contacts(
    contacts: FloatArray, values: FloatArray, *, lengths: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return pairs of contacts (C, 2), and the spans (C, 2) of surface pairs of their length."""
    touching = np.flatnonzero(values == 0.0)
    pairs = touching[np.stack(np.triu_indices(len(touching), 1), axis=1)]
    apart = np.sqrt(((contacts[pairs[:, 0]] - contacts[pairs[:, 1]]) ** 2).sum(axis=1))
    spans = _spans(lengths, apart, reach=_LENGTHS_ALIKE)
    good = (apart >= _LEAST_LENGTH) & (spans[:, 1] > 0)
    return pairs[good], spans[good]


def _spans(ascending: FloatArray, wanted: FloatArray, *, reach: FloatArray | float) -> IntArray:
    """Return first, and how many (N, 2) of the ascending values are near to wanted ones (N,)."""
    first = np.searchsorted(ascending, wanted - reach)
    last = np.searchsorted(ascending, wanted + reach, side="right")
    return np.stack([first, last - first], axis=1)


@compiled
def keep_best(score, anchors, stream, pairs, anchored, first, last, best):
    """Put the samples from `first` to before `last` into a heap in place of worse ones.

    The samples before `pairs` are on pairs of contacts, those before `anchored` on single ones, and
    the others anywhere. They must be later than those in the heap.
    """
    block = np.empty(_SIZE)
    found = Found(
        np.empty(12 * SAMPLES, dtype=np.float32),
        np.empty(SAMPLES),
        np.empty(SAMPLES, dtype=np.uint32),
        np.empty(SAMPLES, dtype=np.float32),
    )
    start = first
    while start < last:
        size = min(_MOST, last - start)
        if start < pairs:
            size = min(size, pairs - start)
            _draw_on_pairs(anchors, stream, start, size, block)
            _turn_about_pairs(block, size)
        else:
            on_contacts = start < anchored
            if on_contacts:
                size = min(size, anchored - start)
            _draw_turned(anchors, stream, start, size, on_contacts, block)
            if anchors.space.planar:
                _turn_on_plane(anchors.space, block, size)
            else:
                _turn_freely(block, size)
        _shift_onto(anchors, block, size)
        cost_of_first(score, block, size, found)
        for n in range(size):
            limit = best.scores[0]
            if block[_WITHIN + n] > 0.0 and found.totals[n] <= limit:
                pose = _pose_in(block, n)
                value = score_below(score, pose, found.totals[n], limit, found)
                if value < limit:
                    _replace_worst(best, value, start + n, pose)
        start += size


@inner
def _replace_worst(best, score, number, pose):
    """Put a pose into the heap in place of the first one."""
    scores = best.scores
    numbers = best.numbers
    at = 0
    child = 1
    while child < len(scores):
        if child + 1 < len(scores) and _is_worse(best, child + 1, scores[child], numbers[child]):
            child += 1
        if not _is_worse(best, child, score, number):
            break
        scores[at], numbers[at] = scores[child], numbers[child]
        for i in range(12):
            best.poses[at, i] = best.poses[child, i]
        at = child
        child = 2 * child + 1
    scores[at], numbers[at] = score, number
    for i in range(12):
        best.poses[at, i] = pose[i]


@leaf
def _is_worse(best, at, score, number):
    """Return whether a pose in the heap is worse than one of this score and number."""
    return best.scores[at] > score or (best.scores[at] == score and best.numbers[at] > number)


@inner
def _draw_on_pairs(anchors, stream, first, count, block):
    """Fill the rows of a block with two surface points each, a pair of contacts, and an angle."""
    spans = anchors.pair_spans
    surface = anchors.surface
    frames = anchors.pair_frames
    for n in range(count):
        shares = uniforms_of_block(stream, first + n)
        pair = _chosen(shares[0], len(spans))
        at = 2 * (spans[pair, 0] + _chosen(shares[1], spans[pair, 1]))
        flip = np.int64(shares[2] < 0.5)
        p, q = anchors.surface_pairs[at + flip], anchors.surface_pairs[at + 1 - flip]
        for axis in range(3):
            block[_ONTO + axis * _MOST + n] = surface[axis, p]
            block[_OTHER + axis * _MOST + n] = surface[axis, q]
            block[_POINT + axis * _MOST + n] = frames[pair, 9 + axis]
        for i in range(9):
            block[_FRAME + i * _MOST + n] = frames[pair, i]
        block[_SHARE + n] = shares[3]


@inner
def _draw_turned(anchors, stream, first, count, on_contacts, block):
    """Fill the rows of a block with points of the world and of the object, and a rotation's shares.

    The former are contacts, or else where the object's origin is.
    """
    spans = anchors.contact_spans
    contacts = anchors.contacts
    for n in range(count):
        shares = uniforms_of_block(stream, first + n)
        if on_contacts:
            contact = _chosen(shares[0], len(spans))
            at = anchors.surface_order[spans[contact, 0] + _chosen(shares[1], spans[contact, 1])]
            outward = anchors.values[contact]
            for axis in range(3):
                met = anchors.surface[axis, at] + outward * anchors.normals[axis, at]
                block[_ONTO + axis * _MOST + n] = met
                block[_POINT + axis * _MOST + n] = contacts[axis, contact]
        else:
            lower, upper = anchors.lower, anchors.upper
            for axis in range(3):
                block[_ONTO + axis * _MOST + n] = 0.0
                extent = upper[axis] - lower[axis]
                block[_POINT + axis * _MOST + n] = lower[axis] + shares[axis] * extent
        for i in range(3):
            block[_SHARE + i * _MOST + n] = shares[3 + i]


@inner
def _turn_about_pairs(block, count):
    """Fill in rotations that turn the line of two surface points onto that of two contacts.

    R = G^T F, with the frames' vectors as rows. `_ONTO` becomes the middle of both points.
    """
    for n in range(count):
        a, b, c = _three(block, _ONTO, n)
        d, e, f = _three(block, _OTHER, n)
        block[_ONTO + n] = 0.5 * (a + d)
        block[_ONTO + _MOST + n] = 0.5 * (b + e)
        block[_ONTO + 2 * _MOST + n] = 0.5 * (c + f)
        x, y, z = _unit(d - a, e - b, f - c)
        steep = abs(x) < _FAR  # else the axis that the line is far from is the second
        a, b, c = _unit(0.0 if steep else z, -z if steep else 0.0, y if steep else -x)
        d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
        sine, cosine = sine_cosine_of_share(block[_SHARE + n])
        a, b, c, d, e, f = (
            cosine * a + sine * d, cosine * b + sine * e, cosine * c + sine * f,
            cosine * d - sine * a, cosine * e - sine * b, cosine * f - sine * c,
        )  # fmt: skip
        f0, f1, f2 = _three(block, _FRAME, n)
        g0, g1, g2 = _three(block, _FRAME + 3 * _MOST, n)
        h0, h1, h2 = _three(block, _FRAME + 6 * _MOST, n)
        _put_row(
            block,
            0,
            n,
            x * f0 + a * g0 + d * h0,
            x * f1 + a * g1 + d * h1,
            x * f2 + a * g2 + d * h2,
        )
        _put_row(
            block,
            1,
            n,
            y * f0 + b * g0 + e * h0,
            y * f1 + b * g1 + e * h1,
            y * f2 + b * g2 + e * h2,
        )
        _put_row(
            block,
            2,
            n,
            z * f0 + c * g0 + f * h0,
            z * f1 + c * g1 + f * h1,
            z * f2 + c * g2 + f * h2,
        )


@inner
def _turn_freely(block, count):
    """Fill in uniform rotations (Shoemake, 1992)."""
    for n in range(count):
        s, c = sine_cosine_of_share(block[_SHARE + n])
        sine, cosine = sine_cosine_of_share(block[_SHARE + _MOST + n])
        share = block[_SHARE + 2 * _MOST + n]
        small = np.sqrt(1.0 - share)
        large = np.sqrt(share)
        x, y, z, w = small * c, large * sine, large * cosine, small * s
        xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
        xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
        xw, yw, zw = 2.0 * x * w, 2.0 * y * w, 2.0 * z * w
        _put_row(block, 0, n, 1.0 - (yy + zz), xy - zw, xz + yw)
        _put_row(block, 1, n, xy + zw, 1.0 - (xx + zz), yz - xw)
        _put_row(block, 2, n, xz - yw, yz + xw, 1.0 - (xx + yy))


@inner
def _turn_on_plane(space, block, count):
    """Fill in rotations about a plane's axis."""
    for n in range(count):
        a, b, c, d, e, f, g, h, i = planar_pose(space, (_TURN * block[_SHARE + n], 0.0, 0.0))[:9]
        _put_row(block, 0, n, a, b, c)
        _put_row(block, 1, n, d, e, f)
        _put_row(block, 2, n, g, h, i)


@inner
def _shift_onto(anchors, block, count):
    """Fill in translations that move points onto those of the object: t = q - R p.

    On a plane they stand on it, whatever the heights of both points. Also fill in whether the
    object's origin, -R^T t, is in its bounds.
    """
    space = anchors.space
    onto_plane = 1.0 if space.planar else 0.0
    p, q, r = space.axis
    low = anchors.lower
    high = anchors.upper
    for n in range(count):
        x, y, z = _three(block, _POINT, n)
        a, b, c = _three(block, _ROTATION, n)
        d, e, f = _three(block, _ROTATION + 3 * _MOST, n)
        g, h, i = _three(block, _ROTATION + 6 * _MOST, n)
        u, v, w = a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
        x = block[_ONTO + n] - u
        y = block[_ONTO + _MOST + n] - v
        z = block[_ONTO + 2 * _MOST + n] - w
        off = onto_plane * (space.offset - (p * x + q * y + r * z))
        x, y, z = x + off * p, y + off * q, z + off * r
        block[_SHIFT + n] = x
        block[_SHIFT + _MOST + n] = y
        block[_SHIFT + 2 * _MOST + n] = z
        x, y, z = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
        beyond = max(low[0] + x, -x - high[0])
        beyond = max(beyond, max(low[1] + y, -y - high[1]))
        beyond = max(beyond, max(low[2] + z, -z - high[2]))
        block[_WITHIN + n] = 1.0 if beyond <= 0.0 else 0.0


@leaf
def _three(block, first, n):
    """Return the n-th numbers of three rows."""
    return block[first + n], block[first + _MOST + n], block[first + 2 * _MOST + n]


@leaf
def _put_row(block, row, n, x, y, z):
    """Set a row of the rotation of the n-th sample."""
    first = _ROTATION + 3 * row * _MOST + n
    block[first] = x
    block[first + _MOST] = y
    block[first + 2 * _MOST] = z


@leaf
def _pose_in(block, n):
    """Return the pose of the n-th sample."""
    first = _three(block, _ROTATION, n)
    second = _three(block, _ROTATION + 3 * _MOST, n)
    third = _three(block, _ROTATION + 6 * _MOST, n)
    return first + second + third + _three(block, _SHIFT, n)


@leaf
def _chosen(share, count):
    """Return the index that a share from 0 to 1 chooses of so many things."""
    return min(np.int64(share * count), count - 1)


@leaf
def _unit(x, y, z):
    """Return a vector of length 1."""
    scale = 1.0 / np.sqrt(max(x * x + y * y + z * z, _SHORTEST_SQUARED))
    return x * scale, y * scale, z * scale
