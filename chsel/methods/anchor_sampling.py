"""Poses that put the object's surface onto contacts, as starts beside E_0 (Alg. 1, line 1).

Poses are drawn and scored in 32 bits, around the contacts. Arrays of them have the poses last, so
that numpy goes along them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.cost.cost_settings import uncertain_depth
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import bounds_of, set_voxels
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import sines_cosines_of_turns
from chsel.numerics.pose_tuples import moved, origin_within, pose_at, turned
from chsel.numerics.threads import parallel_for
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, product, rotated, rotation_matrices
from chsel.problem.prior_kernels import Prior, prior_energy, prior_of
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space, SE3Space, SearchSpace, origin_bounds
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points
from chsel.problem.surface import has_surface, surface_points

UNIT = 2.0**-14  # metres that scores count in, so that a table of 16 bits reaches 2 m
NO_POSE = 2**62  # above the keys of all poses
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_ONE = np.float32(1.0)
_MOST_SAMPLES = 100_000_000
_MOST_KEPT = 100_000
_SURFACE_POINTS = 400  # of which 80 000 pairs are of all lengths
_MOST_ANCHORS = 48  # contacts that the surface is put onto: more are close to these
_MOST_CONTACTS = 32  # that poses are scored by: more are close to these, and take time
_MOST_ORDERED = 64  # known points that are put in order: no fewer than of both above
_MOST_INSIDE = 150  # points inside the object that poses are scored by
_SHARES = 6  # random numbers of a pose, from 0 to 1
_DRAWN_AT_ONCE = 65_536  # poses whose first shares come from a stream before all second ones, ...
_PLACED_AT_ONCE = 8192  # so that their arrays stay in a processor's cache
_SAMPLES_PER_THREAD = 5_000  # fewer take less time than to wake another thread
_LENGTHS_ALIKE = 0.004  # metres, about half of the distance between surface points
_LEAST_LENGTH = 0.01  # metres between two contacts that give a direction
_ROUNDING = 2e-6  # of coordinates in 32 bits, generously
_REACH = 0.06  # metres beyond which known points cost no more, as they may be outliers
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep, as the rest may be noise
_MOST_NODES = 4000  # of which they are chosen; the time for that grows with them
_WEIGHT, _BEYOND = 5.0, 20.0  # of their mean depths in free space, all and those beyond tolerance
_MOST_COST = 2**30  # of all points inside, so that no sum overflows
_MOST_VOXELS = 20_000_000  # of free space: bytes
_FARTHEST = 1e6  # metres: coordinates beyond are taken for it, so that no sum overflows
_FAR = np.float32(0.6)  # from an axis: more than 1 / sqrt(3), so that any direction is far from one
_SHORTEST_SQUARED = np.float32(1e-9)  # of vectors that give a direction
_OFF_NORMAL = 0.02  # metres that the normal of a contact costs which is across
_MOST_OFF_NORMAL = 0.03  # and any other one, at most
_PER_NAT = 0.005  # metres that a nat of the prior costs
_GRADIENT = 127.0  # units of gradients of length 1 in a table of 8 bits
_PER_GRADIENT = np.float32(1.0 / _GRADIENT)


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
        self._space = space
        self._settings = settings
        lower, upper = problem.workspace.bounds
        middle = 0.5 * (lower + upper)
        if len(known.known):  # the median of contacts, so that 32 bits are enough around it
            median = np.sort(known.known, axis=0)[len(known.known) // 2]
            middle = np.minimum(np.maximum(median, lower), upper)
        self._middle = middle
        lower, upper = origin_bounds(problem.workspace, space, margin=settings.margin)
        inset = _ROUNDING * (1.0 + np.abs([lower - middle, upper - middle]).max(axis=0))
        inset = np.minimum(inset, 0.25 * (upper - lower))
        self._lower = _in_32_bits(lower + inset - middle)
        self._upper = _in_32_bits(upper - inset - middle)
        self._free = _free_voxels(problem, settings.margin + problem.sdf.diameter)
        self._set_anchors()

    def _set_anchors(self) -> None:
        """Take contacts, and the surface points that can be put onto them."""
        sdf = self._problem.sdf
        known = self._known
        middle = self._middle
        space = self._space
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
        self._surface, self._normals = _in_32_bits(surface.T), _in_32_bits(normals.T)  # (3, Q)
        self._surface_pairs = pairs  # (2 P,), of indices, by their lengths
        self._surface_order = order  # (Q,), by heights over a plane
        self._contacts = _in_32_bits((contacts[met] - middle).T)  # (3, C)
        self._values = _in_32_bits(values[met])
        # (2, ...)
        self._contact_spans = spans[met].T.copy()
        self._pair_spans = pair_spans.T.copy()
        self._frames = _in_32_bits(_frames(contacts[contact_pairs] - middle).T)  # (12, pairs)

    def best(
        self, samples: int, most: int, *, index: int = 0, tolerance: float = 0.0, left_out: int = 0
    ) -> Poses:
        """Return the best of so many random poses by their coarse score: K poses, best first.

        The score is the mean distance of contacts, and depths of points inside in free space. Of
        equal scores the first is better, so that the result does not depend on threads.
        most: K at most; fewer where the object is out of its bounds too often. index: of the
        stream. tolerance: depth in metres up to which points in free space cost little, at least
        half of a voxel, as voxels are coarse. left_out: 1 for scores without the contact that costs
        a pose the most, as it may be a contact with another object; else 0.
        """
        score = self._coarse_score(tolerance, left_out)
        settings = self._settings
        pairs = round(settings.pairs * samples) if self._frames.size else 0
        anchored = round((settings.pairs + settings.contacts) * samples)
        ends = np.array([pairs, anchored if self._values.size else pairs])
        stream = self._problem.key.stream(Purpose.ANCHORS, index)
        keys = np.zeros(0, dtype=np.int64)
        poses = dict[int, Any]()
        for first in range(0, samples, _DRAWN_AT_ONCE):
            count = min(_DRAWN_AT_ONCE, samples - first)
            shares = stream.random((_SHARES, count), dtype=np.float32)
            keys = self._best_keys(
                score, shares, first=first, ends=ends, keys=keys, most=min(most, samples)
            )
            numbers = keys % 2**32
            new = np.sort(numbers[numbers >= first])
            placed = self._placed(shares[:, new - first], new, ends=ends)
            poses.update(zip(new.tolist(), placed, strict=True))
        chosen = [poses[number] for number in (keys % 2**32).tolist()]
        return self._exact(np.array(chosen, dtype=np.float64).reshape(-1, 12))

    def _best_keys(
        self,
        score: CoarseScore,
        shares: Any,
        *,
        first: int,
        ends: IntArray,
        keys: IntArray,
        most: int,
    ) -> IntArray:
        """Return the best keys, ascending, of those before and of poses from `first` on."""
        heaps: list[IntArray] = []
        worst_first = np.concatenate([np.full(most - len(keys), NO_POSE), keys[::-1]])

        def scratch() -> IntArray:
            heap = worst_first.copy()
            heaps.append(heap)  # another thread may append its own before this one goes on
            return heap

        def run(start: int, stop: int, heap: IntArray) -> None:
            for at in range(start, stop, _PLACED_AT_ONCE):
                part = slice(at, min(at + _PLACED_AT_ONCE, stop))
                numbers = np.arange(first + part.start, first + part.stop)
                keep_best(
                    score, self._placed(shares[:, part], numbers, ends=ends), first + at, heap
                )

        parallel_for(run, shares.shape[1], scratch=scratch, least=_SAMPLES_PER_THREAD)
        merged = np.unique(np.concatenate(heaps))
        return merged[merged < NO_POSE][:most]

    def _placed(self, shares: Any, numbers: IntArray, *, ends: IntArray) -> Any:
        """Return poses (N, 12) from their shares (_SHARES, N) and numbers (N,), which ascend."""
        pairs, singles, others = np.split(shares, np.searchsorted(numbers, ends), axis=1)
        parts = self._on_pairs(pairs), self._on_contacts(singles), self._anywhere(others)
        return np.concatenate(parts, axis=1).T

    def _on_pairs(self, shares: Any) -> Any:
        """Return poses that put two surface points onto the line of two contacts, turned about it.

        R = G^T F, with the frames' vectors as rows.
        """
        pair = _chosen(shares[0], self._pair_spans.shape[1])
        first, count = self._pair_spans.take(pair, axis=1)
        at = 2 * (first + _chosen(shares[1], count))
        flip = shares[2] < _HALF
        p = self._surface.take(self._surface_pairs.take(at + flip), axis=1)
        q = self._surface.take(self._surface_pairs.take(at + ~flip), axis=1)
        x, y, z = along = _unit(q - p)
        none = np.zeros_like(x)  # the cross product with an axis that the line is far from
        a, b, c = across = _unit(np.where(np.abs(x) < _FAR, [none, -z, y], [z, none, -x]))
        other = np.array([y * c - z * b, z * a - x * c, x * b - y * a])
        sine, cosine = sines_cosines_of_turns(shares[3])
        turned = np.array([along, cosine * across + sine * other, cosine * other - sine * across])
        frame = self._frames.take(pair, axis=1)
        rotation = product(turned.T, frame[:9].reshape(3, 3, -1).transpose(2, 0, 1))
        return self._poses(rotation, frame[9:], onto=_HALF * (p + q))

    def _on_contacts(self, shares: Any) -> Any:
        """Return poses that put a surface point onto a contact, or one at its distance."""
        contact = _chosen(shares[0], len(self._values))
        first, count = self._contact_spans.take(contact, axis=1)
        at = self._surface_order[first + _chosen(shares[1], count)]
        outward = self._values[contact] * self._normals.take(at, axis=1)
        met = self._surface.take(at, axis=1) + outward
        return self._poses(self._rotations(shares), self._contacts.take(contact, axis=1), onto=met)

    def _anywhere(self, shares: Any) -> Any:
        """Return poses that put the object's origin anywhere in its bounds."""
        origins = self._lower[:, None] + shares[:3] * (self._upper - self._lower)[:, None]
        return self._poses(self._rotations(shares), origins, onto=np.zeros_like(origins))

    def _rotations(self, shares: Any) -> Any:
        """Return rotations (N, 3, 3) about the plane's axis, or uniform (Shoemake, 1992)."""
        s, c = sines_cosines_of_turns(shares[3])
        if isinstance(self._space, SE2Space):  # Rodrigues' formula
            arrays = self._space.arrays
            rows = [arrays.resting, arrays.turning, arrays.turning_squared]
            resting, turning, squared = _in_32_bits(np.array(rows))[..., None]
            rotations = resting + s * turning + (1 - c) * squared
            return rotations.reshape(3, 3, -1).transpose(2, 0, 1)
        sine, cosine = sines_cosines_of_turns(shares[4])
        small = np.sqrt(1 - shares[5])
        large = np.sqrt(shares[5])
        return rotation_matrices(np.array([small * c, large * sine, large * cosine, small * s]).T)

    def _poses(self, rotation: Any, points: Any, *, onto: Any) -> Any:
        """Return poses (12, N) that move points (3, N) onto points of the object: t = q - R p."""
        shift = onto - rotated(rotation, points.T).T
        space = self._space
        if isinstance(space, SE2Space):  # along the plane's axis until a . t = o
            a, b, c = axis = _in_32_bits(space.axis)
            offset = _in_32_bits(space.offset + float((space.upward * self._middle).sum()))
            off = offset - (a * shift[0] + b * shift[1] + c * shift[2])
            shift = shift + off * axis[:, None]
        return np.concatenate([rotation.transpose(1, 2, 0).reshape(9, -1), shift])

    def _exact(self, numbers: FloatArray) -> Poses:
        """Return poses in the world from those (K, 12) in 32 bits around its middle."""
        rigid = SE3Space()
        turned = rigid.poses(rigid.encode(Poses(numbers)))
        shift = turned.translations - rotated(turned.rotations, self._middle)
        poses = Poses(np.concatenate([turned.numbers[:, :9], shift], axis=1))
        return self._space.poses(self._space.encode(poses))

    def _coarse_score(self, tolerance: float, left_out: int) -> CoarseScore:
        sdf = self._problem.sdf
        known = self._known
        (first, is_free) = self._free
        side = self._problem.free_resolution
        tolerance = max(tolerance, uncertain_depth(sdf, 0.5 * side))
        inside, costs = sdf.derived(("inside", tolerance), lambda: _inside(sdf, tolerance))
        if is_free.size == 1:
            inside, costs = inside[:0], costs[:0]
        contacts = known.known[:_MOST_CONTACTS]
        by_normal = known.has_normals
        prior = self._problem.prior
        costs = max(len(contacts), 1) / (max(len(costs), 1) * UNIT) * costs
        return CoarseScore(
            lower=self._lower,
            upper=self._upper,
            grid=_box(sdf.origin, sdf.resolution, shape=sdf.shape),
            values=sdf.derived("coarse values", lambda: _in_units(sdf.values)),
            contacts=_in_32_bits(contacts - self._middle).T.copy(),
            known_sdf=_in_32_bits(known.sdf[:_MOST_CONTACTS] / UNIT),
            reach=np.float32(_REACH / UNIT),
            by_normal=by_normal,
            gradients=sdf.derived("coarse gradients", lambda: _coarse_gradients(sdf))
            if by_normal
            else np.zeros(1, dtype=np.int8),
            normals=_in_32_bits(known.normals[:_MOST_CONTACTS]).T.copy(),
            off_normal=_in_32_bits(
                np.where(known.normal_noise[:_MOST_CONTACTS] > 0.0, _OFF_NORMAL / UNIT, 0.0)
            ),
            most_off_normal=np.float32(_MOST_OFF_NORMAL / UNIT),
            prior=prior_of(None if prior is None else prior.shifted(-self._middle), sdf),
            per_nat=np.float32(_PER_NAT / UNIT),
            left_out=left_out,
            inside=_in_32_bits(inside),
            weights=np.rint(np.minimum(costs, _MOST_COST / max(len(costs), 1))).astype(np.int32),
            voxels=_box(first - self._middle, side, shape=is_free.shape),
            is_free=is_free.reshape(-1),
        )


def _chosen(shares: Any, sizes: Any) -> IntArray:
    """Return indices (N,) that shares (N,) from 0 to 1 choose of so many things."""
    return np.minimum((shares * np.float32(sizes)).astype(np.int64), np.subtract(sizes, 1))


def _unit(vectors: Any) -> Any:
    """Return vectors (3, N) of length 1."""
    x, y, z = vectors
    return vectors * (1.0 / np.sqrt(np.maximum(x * x + y * y + z * z, _SHORTEST_SQUARED)))


def _in_32_bits(values: Any) -> Any:
    return np.clip(values, -_FARTHEST, _FARTHEST).astype(np.float32)


def _coarse_gradients(sdf: SdfGrid) -> Any:
    """Return gradients at nodes, flat, 8 bits; those of a user's grid may be longer than 1."""
    units = np.rint(_GRADIENT * sdf.gradients)
    return np.clip(units, -_GRADIENT, _GRADIENT).astype(np.int8).reshape(-1)


def _in_units(metres: FloatArray) -> Any:
    """Return distances in UNITs, flat, 16 bits."""
    return np.clip(np.rint(metres / UNIT), -32767, 32767).astype(np.int16).reshape(-1)


def _box(first: FloatArray, resolution: float, *, shape: Sequence[int]) -> Box32:
    """Return the box of a grid of nodes (nx, ny, nz) whose first node is at `first` (3,)."""
    x, y, z = _in_32_bits(first)
    a, b, c = (np.float32(count - 1) for count in shape)
    inverse = np.float32(1.0 / resolution)
    (_, along, last) = shape
    return Box32(
        (x, y, z), inverse, most=(a, b, c), across=np.int32(along * last), along=np.int32(last)
    )


def _inside(sdf: SdfGrid, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Return points (P, 3) inside of the object, the deepest first, and costs (P,), metres."""
    deep = np.argwhere(sdf.values <= _DEEP * min(float(sdf.values.min()), 0.0))
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[farthest_points(deep.astype(np.float64), _MOST_INSIDE)]
    depths = -sdf.values[tuple(nodes.T)]
    order = np.argsort(-depths, kind="stable")
    nodes, depths = nodes[order], depths[order]
    costs = _WEIGHT * depths + _BEYOND * np.maximum(depths - tolerance, 0.0)
    return sdf.origin + nodes * sdf.resolution, costs


def _free_voxels(problem: RegistrationProblem, reach: float) -> tuple[FloatArray, Any]:
    """Return the centre (3,) of the first voxel, and flags (nx, ny, nz) of free voxels."""
    free = problem.points.free
    side = problem.free_resolution
    lower, upper = problem.workspace.bounds
    free = free[((free >= lower - reach) & (free <= upper + reach)).all(axis=1)]
    if len(free):
        bounds = bounds_of(free)
        first = bounds[0] - side
        counts = np.rint((bounds[1] - bounds[0]) / side) + 3.0
        if math.prod(counts.tolist()) < _MOST_VOXELS:
            is_free = np.zeros(counts.astype(np.int64) + 1, dtype=np.bool_)
            set_voxels(free, first, side, is_free)  # the first is (1, 1, 1) to it
            return first, is_free[1:, 1:, 1:]
    return np.zeros(3), np.zeros((1, 1, 1), dtype=np.bool_)


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


class Box32(NamedTuple):
    """The nodes of a grid, each with a cell around it."""

    first: Any  # (3,), the first node, metres
    inverse: Any  # nodes per metre
    most: Any  # (3,), the greatest index per axis
    across: Any  # steps in a flat array to the next node on the first axis,
    along: Any  # and on the second


class CoarseScore(NamedTuple):
    """Data of the coarse score: some known points, and points inside of the object."""

    lower: Any  # (3,), where the object's origin may be
    upper: Any  # (3,)
    grid: Box32  # of signed distances
    values: Any  # (nodes,) in UNITs, read at the nearest node
    contacts: Any  # (3, A), world
    known_sdf: Any  # (A,), in UNITs
    reach: Any  # UNITs beyond which a known point costs no more
    by_normal: bool  # whether normals count
    gradients: Any  # (3 nodes,), 8 bits, of signed distances; (1,) if normals do not count
    normals: Any  # (3, A), of contacts, world
    off_normal: Any  # (A,), UNITs that a normal costs which is across; 0 where there is none
    most_off_normal: Any  # UNITs that a normal costs at most
    prior: Prior  # on poses around the middle
    per_nat: Any  # UNITs that a nat of the prior costs
    left_out: int  # contacts that cost the most and do not count: 0 or 1
    inside: Any  # (P, 3), object frame
    weights: Any  # (P,), cost of each in free space, in UNITs of the sum over contacts
    voxels: Box32  # of free space, world
    is_free: Any  # (voxels,)


@compiled
def keep_best(score, poses, first, keys):
    """Put the keys of poses (N, 12) into a heap of keys, worst first, in place of worse ones.

    A key is 2^32 x score + number, for poses numbered from `first` on: equal scores have an order.
    """
    nodes = np.empty(len(score.known_sdf), dtype=np.uint32)
    beyond = np.empty(len(nodes), dtype=np.float32)
    for n in range(len(poses)):
        pose = pose_at(poses, n)
        if origin_within(pose, score.lower, score.upper):
            _locate(score.grid, pose, score.contacts, nodes, beyond)
            key = (_coarse_score(score, pose, nodes, beyond, keys[0] >> 32) << 32) + first + n
            if key < keys[0]:
                _replace_worst(keys, key)


@leaf
def _replace_worst(keys, key):
    """Put a key into a heap in place of the first one."""
    at, child = 0, 1
    while child < len(keys):
        if child + 1 < len(keys) and keys[child + 1] > keys[child]:
            child += 1
        if key >= keys[child]:
            break
        keys[at] = keys[child]
        at, child = child, 2 * child + 1
    keys[at] = key


@inner
def _locate(grid, pose, contacts, nodes, beyond):
    """Fill in the nodes (A,) nearest to contacts (3, A), and how far these are out of the grid.

    The compiler makes vector instructions of it, as it has no lookups.
    """
    step = np.float32(1.0) / grid.inverse / np.float32(UNIT)
    for n in range(len(nodes)):
        x, y, z = moved(pose, contacts[0, n], contacts[1, n], contacts[2, n])
        x, y, z = x - grid.first[0], y - grid.first[1], z - grid.first[2]
        x, y, z = x * grid.inverse, y * grid.inverse, z * grid.inverse
        u, v, w = _clipped(x, grid.most[0]), _clipped(y, grid.most[1]), _clipped(z, grid.most[2])
        beyond[n] = (abs(x - u) + abs(y - v) + abs(z - w)) * step
        nodes[n] = _node(grid, u, v, w)


@leaf
def _coarse_score(score, pose, nodes, beyond, limit):
    """Return the score of a pose, or a part of it if it is above the limit."""
    total, worst = np.int64(0), np.int64(0)
    for n in range(len(nodes)):
        off = np.float32(score.values[nodes[n]]) + (beyond[n] - score.known_sdf[n])
        cost = np.int64(min(abs(off), score.reach))
        if score.by_normal:
            cost += _normal_cost(score, pose, n, nodes[n])
        total, worst = total + cost, max(worst, cost)
    total -= score.left_out * worst
    total += np.int64(score.per_nat * prior_energy(score.prior, pose))
    voxels = score.voxels
    most = score.voxels.most
    inside = score.inside
    to_voxels = _voxels_from_object(voxels, pose)
    for n in range(len(inside)):
        if total > limit:
            break
        x, y, z = moved(to_voxels, inside[n, 0], inside[n, 1], inside[n, 2])
        x, y, z = _clipped(x, most[0]), _clipped(y, most[1]), _clipped(z, most[2])
        total += score.is_free[_node(voxels, x, y, z)] * score.weights[n]
    return total


@leaf
def _normal_cost(score, pose, n, node):
    """Return the cost of a contact's normal beside the gradient at the node nearest to it."""
    normals = score.normals
    x, y, z = turned(pose, normals[0, n], normals[1, n], normals[2, n])
    at = np.uint64(3) * np.uint64(node)
    u = np.float32(score.gradients[at])
    v = np.float32(score.gradients[at + np.uint64(1)])
    w = np.float32(score.gradients[at + np.uint64(2)])
    cosine = (x * u + y * v + z * w) * _PER_GRADIENT
    return np.int64(min(score.off_normal[n] * (_ONE - cosine), score.most_off_normal))


@leaf
def _voxels_from_object(box, pose):
    """Return R^T and -R^T t in steps of a box, as a pose."""
    scale = box.inverse
    a, b, c = pose[0] * scale, pose[3] * scale, pose[6] * scale
    d, e, f = pose[1] * scale, pose[4] * scale, pose[7] * scale
    g, h, i = pose[2] * scale, pose[5] * scale, pose[8] * scale
    x, y, z = turned((a, b, c, d, e, f, g, h, i), pose[9], pose[10], pose[11])
    x, y, z = -x - box.first[0] * scale, -y - box.first[1] * scale, -z - box.first[2] * scale
    return a, b, c, d, e, f, g, h, i, x, y, z


@leaf
def _clipped(x, most):
    return min(max(x, _ZERO), most)


@leaf
def _node(box, x, y, z):
    """Return the index in a flat array of the node nearest to a point of a box."""
    across = np.int32(x + _HALF) * box.across + np.int32(y + _HALF) * box.along
    return np.uint32(across + np.int32(z + _HALF))  # not counted from the end
