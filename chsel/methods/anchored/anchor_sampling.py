"""Poses that put the object's surface onto contacts, as starts beside E_0 (Alg. 1, line 1)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from chsel.errors import SettingError
from chsel.methods.anchored.sampling_kernels import (
    DRAWS,
    Anchors,
    Best,
    Coarse,
    DrawnRows,
    best_for,
    sample,
)
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import box_of
from chsel.numerics.threads import spread
from chsel.problem.points import KnownPoints, VoxelGrid, voxels_spanned
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space, SearchSpace, origin_bounds
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points
from chsel.problem.surface import has_surface, surface_points

SURFACE_POINTS = 400
MOST_CONTACTS = 32  # that poses are scored by
MOST_ANCHORS = 48  # contacts that the surface is put onto
MOST_INSIDE = 150
MOST_SAMPLES = 100_000_000
MOST_KEPT = 100_000
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep
_MOST_NODES = 4000  # of which they are chosen
_WEIGHT = 90.0  # of the mean depth of the points inside that are in free space
_TOLERANT_WEIGHT = 9.0  # the same where free points may be wrong
_MOST_VOXELS = 20_000_000
_REACH = 0.06  # metres beyond which known points cost no more
_MOST_ORDERED = 64  # known points that are put in order
_BLOCK = 65_536  # poses that are drawn at a time
_SAMPLES_PER_THREAD = 5_000
_LENGTHS_ALIKE = 0.004  # metres
_LEAST_LENGTH = 0.01  # metres between two contacts that give a direction


def coarse_of(
    problem: RegistrationProblem, known: KnownPoints, margin: float, tolerance: float = 0.0
) -> Coarse:
    """The score of poses: mean contact distance, and the depths of points inside in free space.

    known: the problem's points, see most_informative_first. margin: metres by which the object's
    origin may be beside the workspace; free space beyond its reach is left out, and all of it if
    it needs too many voxels. tolerance: depth (m) that free points may have at no cost.
    """
    sdf, resolution = problem.sdf, problem.free_resolution
    values, inside, depth = sdf.derived(
        ("coarse", tolerance), lambda: _values_and_depths(sdf, tolerance)
    )
    weight = _WEIGHT if tolerance == 0.0 else _TOLERANT_WEIGHT
    count = min(len(known.known), MOST_CONTACTS)
    free, (lower, upper) = problem.points.free, problem.workspace.bounds
    reach = margin + sdf.diameter
    free = free[((free >= lower - reach) & (free <= upper + reach)).all(axis=1)]
    box = voxels = box_of(sdf.origin, sdf.resolution, sdf.shape)
    flags = np.zeros(1, dtype=bool)
    if len(free) and voxels_spanned(free, resolution) < _MOST_VOXELS:
        grid = VoxelGrid.around(free, resolution)
        voxels = box_of(grid.origin, resolution, grid.flags.shape)
        flags = grid.flags.reshape(-1)
    else:
        inside, depth = inside[:0], depth[:0]
    return Coarse(
        box=box,
        values=values,
        contacts=known.known[:count].T.copy(),
        known_sdf=known.sdf[:count].copy(),
        scale=1.0 / max(count, 1),
        reach=_REACH,
        inside=inside.T.copy(),
        weights=depth * (weight / max(len(depth), 1)),
        voxels=voxels,
        flags=flags,
    )


def _values_and_depths(sdf: SdfGrid, tolerance: float) -> tuple[Any, FloatArray, FloatArray]:
    """All signed distances, and points (P, 3) inside of the object with their depths (P,)."""
    level = min(_DEEP * min(float(sdf.values.min()), 0.0), -tolerance)
    deep = np.argwhere(sdf.values <= level)
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[farthest_points(deep.astype(np.float64), MOST_INSIDE)]
    depth = -sdf.values[tuple(nodes.T)]
    return sdf.values.astype(np.float32).reshape(-1), sdf.origin + nodes * sdf.resolution, depth


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


def anchored_poses(
    problem: RegistrationProblem,
    known: KnownPoints,
    space: SearchSpace,
    settings: AnchorSettings,
    *,
    samples: int,
    most: int,
    index: int = 0,
    tolerance: float = 0.0,
) -> Poses:
    """The best of so many random poses by their coarse score: K poses, best first.

    known: the problem's points, see most_informative_first. most: K at most; fewer where the
    object is out of its bounds too often. index: of the stream. tolerance: see coarse_of.
    """
    anchors = _anchors(problem, known, space, settings)
    coarse = coarse_of(problem, known, settings.margin, tolerance)
    stream = problem.key.stream(Purpose.ANCHORS, index)
    bests: list[Best] = []

    def scratch() -> Best:
        bests.append(best_for(most))
        return bests[-1]

    def run(first: int, last: int, best: Best) -> None:
        sample(coarse, space.arrays, anchors, rows, first, last, best)

    for before in range(0, samples, _BLOCK):
        draws = stream.random((min(_BLOCK, samples - before), DRAWS), dtype=np.float32)
        rows = DrawnRows(draws, before)
        spread(run, len(draws), scratch, least=_SAMPLES_PER_THREAD)
    scores, numbers, poses = (
        np.concatenate([getattr(best, name)[: best.size[0]] for best in bests])
        for name in ("scores", "numbers", "poses")
    )
    return Poses(poses[np.lexsort([numbers, scores])[:most]])


def most_informative_first(points: KnownPoints) -> KnownPoints:
    """The points, with known ones in the order of farthest points.

    So sums over them rule out poses that do not fit after a few.
    """
    first = farthest_points(points.known, _MOST_ORDERED)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(points.known)), first)])
    return replace(points, known=points.known[order], known_sdf=points.sdf[order])


def _anchors(
    problem: RegistrationProblem, known: KnownPoints, space: SearchSpace, settings: AnchorSettings
) -> Anchors:
    sdf = problem.sdf
    surface, normals, lengths, by_distance = sdf.derived("anchors", lambda: _pairs_of(sdf))
    contacts, values = known.known[:MOST_ANCHORS], known.sdf[:MOST_ANCHORS]
    if isinstance(space, SE2Space):
        by_height, singles, single_spans = _at_heights(space, surface, contacts, values)
        pairs = pair_spans = np.zeros((0, 2), dtype=np.int64)
    else:
        by_height, singles = np.arange(len(surface)), np.arange(len(contacts))
        single_spans = np.tile([0, len(surface)], (len(contacts), 1))
        pairs, pair_spans = _matching(contacts, values, lengths)
    lower, upper = origin_bounds(problem.workspace, space, settings.margin)
    return Anchors(
        contacts=contacts.T.copy(),
        values=values.copy(),
        surface=surface.T.copy(),
        normals=normals.T.copy(),
        by_distance=by_distance,
        pairs=pairs,
        pair_spans=pair_spans,
        singles=singles,
        single_spans=single_spans,
        by_height=by_height,
        pair_share=float(settings.pairs) if len(pairs) else 0.0,
        anchored_share=float(settings.pairs + settings.contacts),
        lower=lower,
        upper=upper,
    )


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
    good = (apart >= _LEAST_LENGTH) & (spans[:, 1] > spans[:, 0])
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
    met = np.flatnonzero(spans[:, 1] > spans[:, 0])
    return order, met, spans[met]


def _spans(ascending: FloatArray, wanted: FloatArray, reach: FloatArray | float) -> IntArray:
    """First and last + 1 (N, 2) of the ascending values that are near to wanted ones (N,)."""
    first = np.searchsorted(ascending, wanted - reach)
    last = np.searchsorted(ascending, wanted + reach, side="right")
    return np.stack([first, last], axis=1)


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
    poses = anchored_poses(
        problem,
        most_informative_first(problem.points),
        space,
        settings.anchors,
        samples=settings.samples,
        most=settings.kept,
        index=index,
    )
    return space.poses(space.encode(poses))
