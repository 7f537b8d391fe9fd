"""The exact cost of an evaluation, and the blocks of positions where it can be low."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter1d

from chsel.cost.interior_points import VoxelGrid
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Box, Region, box_of, clearance_of
from chsel.numerics.octree import Tree, octree
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.plausible.plausible_kernels import Blocks, Bounds, Evaluation, costs_below, room_for
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.problem.points import KnownPoints, Lattice
from chsel.problem.poses import Poses, compose, inverse, product, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_field
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms
from chsel.problem.subset import farthest_points

_POSES_PER_THREAD = 500
_MOST_INSIDE = 128  # points inside of the object that are asked whether they are in free space
_MOST_CANDIDATES = 20_000
_MOST_VOXELS = 20_000_000
_LEVEL_ROUNDING = 1e-12  # metres: what interpolation may lie below all of its corners


class EvaluationCost:
    """C(X) = c_max violated free + c_max violated occupied + |s - v| of known points.

    Sums over points, or the means over each class. A free point at x is violated if
    s(X x) <= -tolerance, an occupied one if s(X x) >= tolerance.
    """

    def __init__(self, problem: RegistrationProblem, settings: EvaluationCostSettings) -> None:
        require_ieee_arithmetic()
        self.settings = settings
        self.points = points = problem.points
        sdf, level = problem.sdf, -settings.tolerance
        tree = octree(points.free, problem.free_resolution)
        region = _region(sdf, level, settings.lookup)
        voxels, point_in = _voxels(tree, problem.free_resolution)
        occupied = points.occupied if settings.occupied else np.zeros((0, 3))
        self.model = Evaluation(
            distance_field(sdf, settings.lookup, settings.outside),
            tree,
            region,
            occupied.T.copy(),
            points.known.T.copy(),
            points.sdf.copy(),
            level,
            settings.violation,
            _divisors(points, settings),
            sdf.derived(("inside", level), lambda: _inside(sdf, level)),
            voxels,
            point_in,
        )

    def evaluate(self, object_from_world: FloatArray, *, limit: float = np.inf) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for those not below `limit`."""
        poses = Poses.of(object_from_world).numbers
        costs = np.empty(len(poses))

        def run(first: int, last: int, room: Any) -> None:
            costs_below(self.model, poses, limit, costs, first, last, room.found)

        def scratch() -> Any:
            return room_for(self.model, 0, 0, 0)

        spread(run, len(poses), scratch, least=_POSES_PER_THREAD)
        return costs


def _divisors(points: KnownPoints, settings: EvaluationCostSettings) -> tuple[float, float, float]:
    if settings.combine == "sums":
        return 1.0, 1.0, 1.0
    free, occupied, known = (
        float(max(len(part), 1)) for part in (points.free, points.occupied, points.known)
    )
    return free, occupied, known


def _region(sdf: SdfGrid, level: float, lookup: str) -> Region:
    """The cells that read any value of `level` or less."""

    def make() -> Region:
        box = box_of(sdf.origin, sdf.resolution, sdf.shape, between=lookup == "trilinear")
        active = sdf.active_cells(level + _LEVEL_ROUNDING, lookup).numpy().reshape(sdf.shape)
        return Region(box, clearance_of(active, sdf.resolution))

    return sdf.derived(("evaluation region", level, lookup), make)


def _inside(sdf: SdfGrid, level: float) -> FloatArray:
    """Points (3, I) inside of the object, far apart from each other."""
    nodes = np.argwhere(sdf.values <= level)
    nodes = nodes[:: max(1, len(nodes) // _MOST_CANDIDATES)]
    points = sdf.origin + nodes * sdf.resolution
    return points[farthest_points(points, _MOST_INSIDE)].T.copy()


def _voxels(tree: Tree, resolution: float) -> tuple[Box, Any]:
    """A layer of empty voxels around those with free points, and a free point of each."""
    nodes = len(tree.starts) - 1
    free = tree.spheres[:3, nodes:].T
    nothing = box_of(np.zeros(3), 1.0, (1, 1, 1)), np.full(1, -1, dtype=np.int32)
    if len(free) == 0 or np.prod(np.ptp(free, axis=0) / resolution + 3.0) > _MOST_VOXELS:
        return nothing
    grid = VoxelGrid.around(free, resolution)
    point_in = np.full(grid.flags.shape, -1, dtype=np.int32)
    voxels = Lattice(tuple(grid.origin.tolist()), resolution).voxels(free)
    point_in[tuple(np.clip(voxels, 0, np.array(grid.flags.shape) - 1).T)] = np.arange(len(free))
    return box_of(grid.origin, resolution, grid.flags.shape), point_in.reshape(-1)


_HALVINGS = 3  # of a block, into up to eight
_TOPS = 48  # uppermost blocks at least
_REACH = 6.0  # cells that a radius may span, else cells are joined
_LEAST_OUTWARD = 1e-9
_UNSURE = 1e-6  # cells: nearer to a border than that, a position may be on either side


def blocks_of(positions: FloatArray, margin: float) -> tuple[Blocks, FloatArray]:
    """The forest of blocks over positions (P, 3), and the radius (L,) of each of its layers.

    margin: metres that every radius is more than it need be.
    """
    layers = [[np.arange(len(positions))]]
    parents: list[list[int]] = []
    while any(len(block) > 1 for block in layers[-1]):
        split = [_split(positions, block, _HALVINGS) for block in layers[-1]]
        parents.append([len(parts) for parts in split])
        layers.append([part for parts in split for part in parts])
    first = next((n for n, layer in enumerate(layers) if len(layer) >= _TOPS), len(layers) - 1)
    layers, counts = layers[first:], parents[first:]
    blocks = [block for layer in layers for block in layer]
    centres = np.array([_centre(positions[block]) for block in blocks])
    layer_of = np.repeat(np.arange(len(layers)), [len(layer) for layer in layers])
    children = np.zeros(len(blocks), dtype=np.int64)
    children[: len(blocks) - len(layers[-1])] = [n for layer in counts for n in layer]
    starts = len(layers[0]) + np.concatenate([[0], np.cumsum(children)])
    position = np.full(len(blocks), -1)
    position[-len(layers[-1]) :] = [block[0] for block in layers[-1]]
    radii = [max(_radius(positions[block]) for block in layer) for layer in layers]
    forest = Blocks(centres.T.copy(), layer_of, starts, len(layers[0]), position)
    return forest, np.array(radii) * (1.0 + 1e-9) + margin


def bounds_of(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> Bounds:
    """Bounds of what a grid reads within each of the radii (L,), in metres, of any point.

    The last radius is that of single positions: no more than what rounding moves them.
    """
    key = ("bounds", lookup, outside, tuple(radii.tolist()))
    return sdf.derived(key, lambda: _bounds(sdf, lookup, outside, radii))


def _split(positions: FloatArray, block: np.ndarray, halvings: int) -> list[np.ndarray]:
    """Halve a block along its longest side, and its halves again."""
    if halvings == 0 or len(block) == 1:
        return [block]
    extent = np.ptp(positions[block], axis=0)
    order = np.argsort(positions[block, int(np.argmax(extent))], kind="stable")
    middle = (len(block) + 1) // 2
    parts = block[order[:middle]], block[order[middle:]]
    return [piece for part in parts for piece in _split(positions, part, halvings - 1)]


def _centre(points: FloatArray) -> FloatArray:
    if len(points) == 1:
        return points[0]
    return (points.min(axis=0) + points.max(axis=0)) / 2.0


def _radius(points: FloatArray) -> float:
    if len(points) == 1:
        return 0.0
    return float(np.sqrt(((points - _centre(points)) ** 2).sum(axis=1).max()))


def _bounds(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> Bounds:
    lowest, highest, corner = _cells(sdf, lookup)
    deep = outside == "surface_point" and _points_outward(sdf)
    tables, numbers, row = [], [], 0
    for n, radius in enumerate(radii.tolist()):
        factor = max(1, int(radius / (_REACH * sdf.resolution)))
        size, unsure = factor * sdf.resolution, 0.0
        if n < len(radii) - 1:
            low = _around(_joined(lowest, factor), size, radius)
            high = -_around(_joined(-highest, factor), size, radius)
        else:
            low, high, unsure = lowest.copy(), highest, max(_UNSURE, radius / size)
        if not deep:
            _open_border(low, size, radius)
        box = [*(sdf.bounds[0] - corner)[:1] / size, *(sdf.bounds[1] - corner) / size]
        _, ny, nz = low.shape
        numbers.append(
            [
                *corner,
                1.0 / size,
                *box,
                *(np.array(low.shape) - 1),
                ny * nz,
                nz,
                row,
                radius,
                unsure,
            ]
        )
        table = np.stack([_rounded(low, -np.inf), _rounded(high, np.inf)], axis=-1)
        tables.append(table.reshape(-1, 2))
        row += low.size
    # With gradients that point away from the grid's box, the nearest surface point is nearer to
    # the box's inside, so that a way out of the box adds to the way to the surface.
    reach = 1.0 if deep or outside == "bounding_box" else 0.0
    table = np.concatenate(tables)
    return Bounds(np.array(numbers, dtype=np.float64), table, reach)


def _cells(sdf: SdfGrid, lookup: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and greatest value that each cell reads, and the corner (3,) of the first cell."""
    values = sdf.values
    if lookup == "nearest":
        return values, values, sdf.origin - 0.5 * sdf.resolution
    nx, ny, nz = (count - 1 for count in sdf.shape)
    corners = [values[i : i + nx, j : j + ny, k : k + nz] for i, j, k in np.ndindex(2, 2, 2)]
    rounding = 1e-12 * (1.0 + np.abs(values).max())  # of interpolation
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    return low - rounding, high + rounding, sdf.origin


def _joined(values: FloatArray, factor: int) -> FloatArray:
    """Least values of cubes of so many cells along each side."""
    pad = [(0, -count % factor) for count in values.shape]
    padded = np.pad(values, pad, mode="edge")
    a, b, c = (count // factor for count in padded.shape)
    cubes = padded.reshape(a, factor, b, factor, c, factor)
    return cubes.min(axis=(1, 3, 5))


def _around(values: FloatArray, size: float, radius: float) -> FloatArray:
    """The least value of all cells that have a point within a radius of a point of each cell."""
    reach = int(np.floor(radius / size)) + 1
    gap = np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * size
    columns: dict[int, FloatArray] = {}
    out = np.full(values.shape, np.inf)
    shape = values.shape
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            left = radius**2 - gap[i + reach] ** 2 - gap[j + reach] ** 2
            if left < 0.0:
                continue
            length = int(np.floor(np.sqrt(left) / size)) + 1
            if length not in columns:
                columns[length] = minimum_filter1d(values, 2 * length + 1, axis=2, mode="nearest")
            to_x, from_x = _shifted(i, shape[0])
            to_y, from_y = _shifted(j, shape[1])
            target = out[to_x, to_y]
            np.minimum(target, columns[length][from_x, from_y], out=target)
    return out


def _shifted(step: int, count: int) -> tuple[slice, slice]:
    """Where cells are, and those `step` cells on."""
    step = max(-count, min(step, count))
    return slice(max(-step, 0), count - max(step, 0)), slice(max(step, 0), count + min(step, 0))


def _open_border(low: FloatArray, size: float, radius: float) -> None:
    """Beyond the grid any distance down to 0 may be read: also by what comes near its border."""
    depth = int(np.floor(radius / size)) + 1
    for axis in range(3):
        index = np.arange(low.shape[axis])
        near = (index < depth) | (index >= low.shape[axis] - depth)
        part = np.moveaxis(low, axis, 0)
        part[near] = np.minimum(part[near], 0.0)


def _points_outward(sdf: SdfGrid) -> bool:
    """Whether the gradients on every face of the grid point out of it."""
    for axis in range(3):
        for end, sign in ((0, -1.0), (-1, 1.0)):
            face = np.take(sdf.gradients[..., axis], end, axis=axis)
            if (sign * face).min() <= _LEAST_OUTWARD:
                return False
    return True


def _rounded(values: FloatArray, towards: float) -> Any:
    """Numbers of 32 bits that are no nearer than `values` on the far side of them."""
    return np.nextafter(values.astype(np.float32), np.float32(towards))


_ROUNDS, _MOST_ROUNDS = 8, 64  # the latter where the former find fewer than wanted
_DRAWN = 4000  # poses a round
_ENOUGH = 20  # times as many as wanted, to choose from
_POSITION, _ANGLE = 0.01, 0.1  # standard deviations at first, metres and radians
_SHRINK = 0.5
_LEAST_SCALE = _SHRINK ** (_ROUNDS - 1)
_FEW = 0.02  # members among those drawn, of which a later round makes steps shorter


def local_members(
    cost: EvaluationCost,
    members: FloatArray,
    limit: float,
    wanted: int,
    *,
    lever: float,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Up to `wanted` poses (W, 4, 4) near members (P, 4, 4), world_from_object, and their costs.

    Rounds of normal steps in position and rotation vector from members, those found in earlier
    rounds among them, so that the search walks along the set; the steps get shorter after a round
    that found nothing, and in a thin set, where the first rounds find too few, after one that
    found little. Of all found that cost less than the limit, those are taken that are the
    farthest from each other and from the members; `lever`: metres that a radian counts for. They
    say how far the set reaches around its known members, not where else it has any.
    """
    known, pool, costs, scale = len(members), members, np.zeros(0), 1.0
    for n in range(_MOST_ROUNDS):
        if n == _ROUNDS and len(costs) >= wanted:
            break
        stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, 2 + n)
        steps = normals(stream, (_DRAWN, 6)) * scale
        starts = pool[np.floor(uniforms(stream, 0.0, float(len(pool)), _DRAWN)).astype(int)]
        turned = product(rotation_vector(_ANGLE * steps[:, 3:]), starts[:, :3, :3])
        drawn = compose(turned, starts[:, :3, 3] + _POSITION * steps[:, :3])
        drawn_costs = cost.evaluate(inverse(drawn), limit=limit)
        good = drawn_costs < limit
        pool = np.concatenate([pool, drawn[good]])
        costs = np.concatenate([costs, drawn_costs[good]])
        few = _FEW * _DRAWN if n >= _ROUNDS - 1 else 1
        scale = scale if good.sum() >= few else max(_SHRINK * scale, _LEAST_SCALE)
        if n >= _ROUNDS // 2 and len(costs) >= _ENOUGH * wanted:
            break
    places = np.concatenate([pool[:, :3, 3], lever * pool[:, :3, :3].reshape(-1, 9)], axis=1)
    chosen = np.sort(farthest_points(places, known + wanted, given=known))[known:]
    return pool[chosen], costs[chosen - known]
