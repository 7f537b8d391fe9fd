"""The iterations of CMA-ME on the Medial Constraint cost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.pose_tuples import decode, finite, pose_at
from chsel.problem.sdf_lookup import Field, continued, sample
from chsel.qd.archive import Batch, Cells, all_finite, insert, rank
from chsel.qd.emitter_kernels import Landscape, MeSearch, SearchDraws, move_to_elite
from chsel.qd.evolution_kernels import ask, reset, stopped, tell
from chsel.qd.measures import measures_of

_FAR = 2**60


@compiled
def squared_clearances(inside: BoolArray, out: IntArray) -> None:
    """Fill out (nx, ny, nz) with squared distances from the centres of voxels to the set's border.

    In half sides of a voxel: the least over all voxels w that are not inside, taken as cubes, of
    the sum over the axes of max(2 |v - w| - 1, 0)^2. As it is a sum over the axes, one axis after
    the other finds it (Felzenszwalb and Huttenlocher, 2012). At least one voxel must be outside.
    """
    flat, flags = out.reshape(-1), inside.reshape(-1)
    for n in range(len(flat)):
        flat[n] = _FAR if flags[n] else 0
    nx, ny, nz = out.shape
    line = np.empty(max(nx, ny, nz), dtype=np.int64)
    _along(flat, nz, 1, line)
    _along(flat, ny, nz, line)
    _along(flat, nx, ny * nz, line)


@inner
def _along(flat: IntArray, count: int, stride: int, line: IntArray) -> None:
    """One axis, whose neighbours are `stride` apart in lines of `count` voxels."""
    for block in range(0, len(flat), count * stride):
        for start in range(block, block + stride):
            for k in range(count):
                line[k] = flat[start + k * stride]
            for k in range(count):
                flat[start + k * stride] = _nearest(line, count, k)


@inner
def _nearest(line: IntArray, count: int, k: int) -> int:
    """The least of line[j] + max(2 |k - j| - 1, 0)^2, going outwards while that can be less."""
    least, reach = line[k], max(k, count - 1 - k)
    for step in range(1, reach + 1):
        more = (2 * step - 1) * (2 * step - 1)
        if more >= least:
            break
        if step <= k:
            least = min(least, line[k - step] + more)
        if k + step < count:
            least = min(least, line[k + step] + more)
    return least


_TOLERANCE = 2e-3  # half sides, by which a ball may stick out of the one that holds it


@compiled
def mark_medial(squared: IntArray, out: BoolArray) -> None:
    """Fill out (nx, ny, nz): voxels of the set whose ball is in the ball of no neighbour.

    squared (nx, ny, nz): squared clearances, 0 outside of the set and on the outermost layer.
    """
    nx, ny, nz = squared.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = squared[i, j, k] > 0 and not _held(squared, i, j, k)


@inner
def _held(squared: IntArray, i: int, j: int, k: int) -> bool:
    """Whether |c_u - c_v| + r_v <= r_u for any of the 26 neighbours u of a voxel v."""
    own = squared[i, j, k]
    radius = np.sqrt(float(own))
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                other = squared[i + a, j + b, k + c]
                if other > own:
                    apart = 2.0 * np.sqrt(float(a * a + b * b + c * c))
                    if apart + radius <= np.sqrt(float(other)) + _TOLERANCE:
                        return True
    return False


@compiled
def covering(
    voxels: IntArray, radii: FloatArray, rows: IntArray, order: IntArray, inflation: float
) -> IntArray:
    """Indices of balls that, once inflated, cover all others; each the next that none does so far.

    voxels (P, 3), ascending in row-major order, with radii (P,). rows (nx, ny + 1): of every row of
    voxels along the last axis, where it starts in `voxels`; the next entry is its end. order (P,):
    in which balls are taken. Ball i covers ball j if |c_i - c_j| + r_j <= r_i + inflation.
    """
    covered, chosen = np.zeros(len(order), dtype=np.bool_), np.empty(len(order), dtype=np.int64)
    count = 0
    for i in order:
        if not covered[i]:
            _cover(voxels, radii, rows, i, inflation, covered)
            chosen[count] = i
            count += 1
    return chosen[:count].copy()


@inner
def _cover(
    voxels: IntArray,
    radii: FloatArray,
    rows: IntArray,
    i: int,
    inflation: float,
    covered: BoolArray,
) -> None:
    """Mark the balls that ball i covers; their centres are within reach = r_i + inflation."""
    x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
    nx, ny, reach = len(rows), rows.shape[1] - 1, radii[i] + inflation
    steps = int(min(0.5 * reach, float(nx + ny))) + 1
    for row in range(max(x - steps, 0), min(x + steps + 1, nx)):
        for column in range(max(y - steps, 0), min(y + steps + 1, ny)):
            aside = (row - x) * (row - x) + (column - y) * (column - y)
            if 4.0 * aside > reach * reach:
                continue
            for j in range(rows[row, column], rows[row, column + 1]):
                apart = 4.0 * (aside + (voxels[j, 2] - z) * (voxels[j, 2] - z))
                margin = reach - radii[j]
                if margin >= 0.0 and apart <= margin * margin:
                    covered[j] = True


class MedialModel(NamedTuple):
    """All that the cost of a pose hangs on; points and balls of the world, metres.

    least (nodes,): the least value that is read in a cell of the field's grid, or less. centres
    (3, N_b) and radii (N_b,) of the balls. known (3, N_k) and known_sdf (N_k,).
    """

    field: Field
    least: FloatArray
    centres: FloatArray
    radii: FloatArray
    known: FloatArray
    known_sdf: FloatArray
    ball_scale: float
    known_scale: float


def medial_places(model: MedialModel) -> Places:
    """Scratch for one thread."""
    return places_for(max(len(model.radii), len(model.known_sdf)))


@inner
def medial_cost(model, pose, places):
    """mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, m^2, each scaled.

    Infinite for a pose that is not finite; a mean over nothing is 0.
    """
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, places)
    cost += model.known_scale * _known_mean(model, pose, places)
    return cost if cost < np.inf else np.inf  # nan is infinite, too


@spliced
def _ball_mean(model, pose, places):
    """The mean square of how deep balls reach into the object.

    A ball is looked up only where it can reach so far: beyond the grid, an object that lies within
    is no nearer than the hypotenuse of the ways to the grid and from there.
    """
    field, radii, least = model.field, model.radii, model.least
    box, xs, ys, zs = field.box, model.centres[0], model.centres[1], model.centres[2]
    locate(pose, box, xs, ys, zs, places, len(radii))
    total = 0.0
    for n in range(len(radii)):
        beyond, radius = places.beyond[n], radii[n]
        further = max(least[places.cell[n]], 0.0)
        further = 0.0 if field.box_distance and beyond > 0.0 else further * further
        if beyond + further < radius * radius:
            depth = max(radius - _distance(field, pose, xs[n], ys[n], zs[n], places, n), 0.0)
            total += depth * depth
    return total / max(len(radii), 1)


@spliced
def _known_mean(model, pose, places):
    """The mean square of s - v over points of known signed distance v, 0 for contacts."""
    field, known_sdf = model.field, model.known_sdf
    box, xs, ys, zs = field.box, model.known[0], model.known[1], model.known[2]
    locate(pose, box, xs, ys, zs, places, len(known_sdf))
    total = 0.0
    for n in range(len(known_sdf)):
        difference = _distance(field, pose, xs[n], ys[n], zs[n], places, n) - known_sdf[n]
        total += difference * difference
    return total / max(len(known_sdf), 1)


@inner
def _distance(field, pose, x, y, z, places, n):
    """Signed distance at the n-th of the places, that of a world point x, y, z."""
    if places.beyond[n] > 0.0:
        inside = sample(field.trilinear, field.box, field.table, places, n)
        a = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
        b = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
        c = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
        return continued(field.box_distance, field.box, inside, a, b, c)[0]
    return sample(field.trilinear, field.box, field.table, places, n)[0]


@spliced
def cost_of(model, space, vector, places):
    """The cost of a search vector (d,)."""
    return medial_cost(model, decode(space, vector), places)


@compiled
def medial_costs_of_poses(model, poses, out, first, last, places):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = medial_cost(model, pose_at(poses, n), places)


@compiled
def medial_cma_me(
    landscape: Landscape,
    archive: Cells,
    search: MeSearch,
    draws: SearchDraws,
    first: int,
    last: int,
) -> None:
    """Iterations of CMA-ME, as chsel.qd.emitter_kernels.cma_me has them, on another objective."""
    samples, strategy = search.samples, search.strategy
    for iteration in range(first, last):
        ask(strategy, draws.normals[iteration], samples.vectors)
        _evaluate(landscape, samples)
        insert(archive, samples)
        parents = rank(samples.status, samples.value, samples.order)
        tell(strategy, samples.vectors, samples.order, parents)
        if parents == 0 or stopped(strategy, samples.order, samples.status, samples.value):
            move_to_elite(archive, draws.elites[iteration], strategy.mean)
            reset(strategy)


@spliced
def _evaluate(landscape: Landscape, batch: Batch) -> None:
    """Fill objectives and measures; a vector that is not finite is not looked up anywhere."""
    model, space, measure, work = landscape
    vectors, objectives, measures = batch.vectors, batch.objectives, batch.measures
    for i in range(len(objectives)):
        vector = vectors[i]
        if all_finite(vector):
            objectives[i] = -cost_of(model, space, vector, work)
            measures_of(space, measure, vector, measures[i])
        else:
            objectives[i] = -np.inf
