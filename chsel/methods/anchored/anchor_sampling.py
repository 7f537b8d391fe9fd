"""Starts beside E_0: poses that put the object's surface onto contacts (for Alg. 1, line 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from chsel.cost.interior_points import VoxelGrid
from chsel.errors import SettingError, require_at_most, require_positive
from chsel.methods.anchored.sampling_kernels import DRAWS, Anchors, Best, Coarse, best_for, sample
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import box_of
from chsel.numerics.threads import spread
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space, SearchSpace, origin_bounds
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points
from chsel.problem.surface import has_surface, surface_points

MOST_CONTACTS = 32
MOST_INSIDE = 150
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep
_MOST_NODES = 4000  # of which they are chosen
_WEIGHT = 90.0  # of the mean depth of the points inside that are in free space
_MOST_VOXELS = 20_000_000


def coarse_of(problem: RegistrationProblem, known: KnownPoints, margin: float) -> Coarse:
    """The score of poses: mean contact distance, and the depths of points inside in free space.

    known: the problem's points, in the order in which they tell most. margin: metres by which the
    object's origin may be beside the workspace; free space beyond its reach is left out, and all
    of it if it needs more voxels than memory should hold.
    """
    sdf, resolution = problem.sdf, problem.free_resolution
    values, inside, depth = sdf.derived("coarse", lambda: _values_and_depths(sdf))
    count = min(len(known.known), MOST_CONTACTS)
    free = _within_reach(problem, margin + sdf.diameter)
    box = voxels = box_of(sdf.origin, sdf.resolution, sdf.shape)
    flags = np.zeros(1, dtype=bool)
    if len(free) and math.prod((np.ptp(free, axis=0) / resolution + 3.0).tolist()) < _MOST_VOXELS:
        grid = VoxelGrid.around(free, resolution)
        voxels = box_of(grid.origin, resolution, grid.flags.shape)
        flags = grid.flags.reshape(-1)
    else:
        inside, depth = inside[:0], depth[:0]
    return Coarse(
        box,
        values,
        known.known[:count].T.copy(),
        known.sdf[:count].copy(),
        1.0 / max(count, 1),
        inside.T.copy(),
        depth * (_WEIGHT / max(len(depth), 1)),
        voxels,
        flags,
    )


def _within_reach(problem: RegistrationProblem, reach: float) -> FloatArray:
    """The free points that the object can meet."""
    free, (lower, upper) = problem.points.free, problem.workspace.bounds
    return free[((free >= lower - reach) & (free <= upper + reach)).all(axis=1)]


def _values_and_depths(sdf: SdfGrid) -> tuple[Any, FloatArray, FloatArray]:
    """All signed distances, and points (P, 3) inside of the object with their depths (P,)."""
    deep = np.argwhere(sdf.values <= _DEEP * min(float(sdf.values.min()), 0.0))
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[farthest_points(deep.astype(np.float64), MOST_INSIDE)]
    depth = -sdf.values[tuple(nodes.T)]
    return sdf.values.astype(np.float32).reshape(-1), sdf.origin + nodes * sdf.resolution, depth


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
) -> Poses:
    """The best of so many random poses by their coarse score: K poses, best first.

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
    return Poses(poses[np.lexsort([numbers, scores])[:most]])


def in_telling_order(points: KnownPoints) -> KnownPoints:
    """The points, with known ones in the order in which they tell most: each far from the others.

    So poses that do not fit are found out early.
    """
    first = farthest_points(points.known, _TELLING)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(points.known)), first)])
    return replace(points, known=points.known[order], known_sdf=points.sdf[order])


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
        *origin_bounds(problem.workspace, space, settings.margin),
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
    wanted = (contacts * space.upward).sum(axis=1) + space.offset
    reach = _LENGTHS_ALIKE + np.abs(values)
    first = np.searchsorted(heights[order], wanted - reach)
    last = np.searchsorted(heights[order], wanted + reach, side="right")
    singles = np.stack([np.arange(len(contacts)), first, last], axis=1)
    return order, singles[last > first]


MOST_SAMPLES = 100_000_000
MOST_KEPT = 100_000


@dataclass(frozen=True)
class AnchoredStarts:
    """How many: samples, the poses drawn on contacts; kept, those of them that score best."""

    samples: int = 10_000
    kept: int = 30
    anchors: AnchorSettings = field(default_factory=AnchorSettings)

    def __post_init__(self) -> None:
        require_positive("samples", self.samples)
        require_positive("kept", self.kept)
        require_at_most("samples", self.samples, MOST_SAMPLES)
        require_at_most("kept", self.kept, MOST_KEPT)


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
        in_telling_order(problem.points),
        space,
        settings.anchors,
        samples=settings.samples,
        most=settings.kept,
        index=index,
    )
    return space.poses(space.encode(poses))
