"""CVO: ascent of the inner product of two labelled clouds (baseline of the paper).

After Clark, Ghaffari et al. (2021) and Zhang, Ghaffari et al. (2021), with two classes: free
space and surface. Clouds are functions f = sum_j k(., z_j) of a reproducing kernel Hilbert space.
That of the object's cloud, nodes of its SDF, is a table of 32 bits on a grid; sums are of 64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Box, Places, box_of, locate, places_for, triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, exps, sine_cosine
from chsel.numerics.pose_tuples import Triple, composed, moved, pose_at, turned_back
from chsel.numerics.threads import parallel_for
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.sdf_grid import COARSEST, FINEST, SdfGrid
from chsel.problem.sdf_lookup import distance_between_nodes
from chsel.problem.settings import (
    CheckedSettings,
    Presets,
    at_most,
    between,
    not_negative,
    one_of,
    positive,
)
from chsel.qd.selection import ranked

MOST_ITERATIONS = 1_000_000
_BLOCK = 10  # iterations between two traces
_PATIENCE = 2
_REFINEMENTS = 3
_NEAR = 0.05  # steps count as equally long if they differ by less than this fraction
MOST_NODES = 30_000_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them
TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_POINTS = 64  # that are located at once
_FEW = 2000  # points that are taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


@dataclass(frozen=True)
class CvoSettings(CheckedSettings):
    """Settings of CVO; names as in the authors' parameter file."""

    free_space: bool = True  # use free points; else contacts and the object's surface alone
    balanced: bool = False  # weigh contacts by the number of free points per contact
    # Length scale of the kernel, metres. After an ascent it is multiplied by ell_decay and another
    # ascent follows, as long as it is above ell_min.
    ell: Annotated[float, positive, between(FINEST, COARSEST)] = 0.1
    ell_min: Annotated[float, positive, between(FINEST, COARSEST)] = 0.025  # the least, metres
    ell_decay: Annotated[float, positive, at_most(0.99)] = 0.5  # factor
    # Nodes of the SDF within it of the surface make the object's surface, those farther outside its
    # free space, metres; null: the SDF's resolution (r_t).
    surface_band: Annotated[float | None, positive] = None
    # Divisors of the rotational and the translational part of the flow, so that a turn by 1 rad
    # counts as a shift by sqrt(c / d) m.
    c: Annotated[float, positive] = 0.07
    d: Annotated[float, positive] = 7.0  # of translation
    # The flow turns about the workspace's centre, or the "world" origin as published.
    origin: Annotated[str, one_of("world", "workspace")] = "workspace"
    max_iterations: Annotated[int, positive, at_most(MOST_ITERATIONS)] = 100  # of an ascent
    min_step: Annotated[float, positive] = 1e-4  # least length of a step that is tried first
    # Greatest length of a step that is tried first.
    max_step: Annotated[float, positive, at_most(1.0)] = 0.8
    # A start ends when its inner product grew by no more than this fraction in 2 iterations in a
    # row; null: never.
    stop_below: Annotated[float | None, not_negative] = 1e-5
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)

    _AUTHORS: ClassVar = {"ell_min": 0.1, "c": 7.0, "origin": "world", "stop_below": None}
    presets: ClassVar[Presets] = {
        "paper": _AUTHORS,
        "reference": {**_AUTHORS, "surface_band": 0.005, "online": {"update": "own"}},
    }

    @property
    def levels(self) -> list[float]:
        """The length scales of the ascents, metres."""
        levels = [self.ell]
        while levels[-1] > self.ell_min * (1.0 + 1e-9):
            levels.append(max(levels[-1] * self.ell_decay, self.ell_min))
        return levels


class Cvo(ConfiguredMethod[CvoSettings]):
    """Climbs the inner product of two clouds from every pose of E_0; E_l is not used.

    The observed cloud x: free points, and contacts; the object's z: nodes of the SDF grid within
    surface_band of the surface, and those farther outside. F(X) = sum_ij a(R x_i + t, z_j) over
    pairs of one class, with a = exp(-|x - z|^2 / (2 ell^2)). Cost: 1 - F / (|f_x| |f_z|), at the
    last ell; 1 where clouds do not meet. Such a start stays where it is, as all of E_0 if there
    is no point to use; only free points and contacts are. A trace has the costs at its own ell.
    """

    settings_class = CvoSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        settings = self.settings
        estimates = Poses.of(problem.initial_set)
        poses = estimates.numbers
        (lower, upper) = problem.workspace.bounds
        centre = (lower + upper) / 2.0 if settings.origin == "workspace" else np.zeros(3)
        stop_below = -1.0 if settings.stop_below is None else settings.stop_below
        most = settings.max_iterations
        ascent = Ascent(
            settings.min_step,
            settings.max_step,
            centre=triple(centre),
            c=settings.c,
            d=settings.d,
            stop_below=stop_below,
        )
        for level, ell in enumerate(settings.levels):
            product, norm = self._clouds(problem, Kernel(ell))
            climbers = climbers_at(product, poses)
            if level == 0:
                observer.trace("ascent", 0, estimates.vectors, _costs(climbers.value, norm))
            for first in range(0, most, _BLOCK):
                last = min(first + _BLOCK, most)
                run = partial(climb, product, ascent, climbers, last - first)
                parallel_for(run, len(poses), scratch=_places)
                estimates = Poses(climbers.poses.copy())
                done = level * most + last
                observer.trace("ascent", done, estimates.vectors, _costs(climbers.value, norm))
                observer.progress("ascent", done, most * len(settings.levels))
                if climbers.done.all():
                    break
            poses = climbers.poses
        return ranked(estimates.matrices, _costs(climbers.value, norm))

    def _clouds(self, problem: RegistrationProblem, kernel: Kernel) -> tuple[Product, float]:
        """Return F, and |f_x| |f_z|."""
        sdf = problem.sdf
        lattice = problem.free_resolution
        contacts = problem.points.contacts
        band = self.settings.surface_band or sdf.resolution
        free = problem.points.free if self.settings.free_space else np.zeros((0, 3))
        balanced = self.settings.balanced and len(contacts) and len(free)
        weight = len(free) / len(contacts) if balanced else 1.0
        surface_z = class_field(sdf, kernel, band=band, name="surface")
        observed = weight * cloud_norm(contacts, kernel, lattice=lattice)
        of_object = weight * surface_z.norm
        terms = [ClassTerm(contacts.T.copy(), surface_z, weight=weight)]
        if self.settings.free_space:
            free_z = class_field(sdf, kernel, band=band, name="free")
            observed += cloud_norm(free, kernel, lattice=lattice)
            of_object += free_z.norm
            alone, cubes, wide = full_cubes(free, kernel, lattice=lattice)
            cube_z = class_field(sdf, wide, band=band, name="free") if len(cubes) else free_z
            terms[:0] = ClassTerm(alone.T.copy(), free_z), ClassTerm(cubes.T.copy(), cube_z)
        return tuple(terms), float(np.sqrt(observed * of_object))


def _costs(values: FloatArray, norm: float) -> FloatArray:
    """Return 1 - F / (|f_x| |f_z|), in [0, 1] but for the field's interpolation."""
    return 1.0 - values / norm if norm > 0.0 else np.ones(len(values))


class Ascent(NamedTuple):
    """Settings of the ascent as kernels take them."""

    least: float  # and
    most: float  # tau of a step that is tried first
    centre: Triple  # that the flow turns about, world
    c: float  # scale of the flow's rotation
    d: float  # and of its translation
    stop_below: float  # relative gain of F that counts as none; negative: every gain counts


class Climbers(NamedTuple):
    """The starts of an ascent and how far they are; `climb` changes them in place."""

    poses: FloatArray  # (B, 12)
    value: FloatArray  # (B,), F
    step: FloatArray  # (B,), tau of the last step, 0 before the first
    stalled: IntArray  # (B,), iterations in a row that gained nothing
    done: BoolArray  # (B,)


def climbers_at(product: Product, poses: FloatArray) -> Climbers:
    """Return climbers at copies of poses (B, 12), before the first step."""
    value = values_of(product, poses)
    step = np.zeros(len(poses))
    stalled = np.zeros(len(poses), dtype=np.int64)
    done = np.zeros(len(poses), dtype=bool)
    return Climbers(poses.copy(), value, step=step, stalled=stalled, done=done)


def _places() -> Places:
    """Return scratch for one thread."""
    return places_for(_POINTS)


@compiled
def climb(product, ascent, climbers, iterations, first, last, places):
    """Move climbers uphill for some iterations, those from `first` to before `last`."""
    for n in range(first, last):
        for _ in range(iterations):
            if not climbers.done[n]:
                pose = pose_at(climbers.poses, n)
                xi, slope = _direction(product, ascent, pose, places)
                climbers.done[n] = True
                if slope > 0.0:
                    uphill = _step(product, ascent, pose, xi, slope, climbers, n, places)
                    climbers.done[n] = not uphill


@inner
def _direction(product, ascent, pose, places):
    """Return the unit flow (1/c sum x_i x h_i, 1/d sum h_i) about the origin, and F's slope."""
    flow = flow_at(product, pose, ascent.centre, places)
    a, b, c = flow[1] / ascent.c, flow[2] / ascent.c, flow[3] / ascent.c
    d, e, f = flow[4] / ascent.d, flow[5] / ascent.d, flow[6] / ascent.d
    size = np.sqrt(a * a + b * b + c * c + d * d + e * e + f * f)
    if not 0.0 < size < np.inf:
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0
    a, b, c, d, e, f = a / size, b / size, c / size, d / size, e / size, f / size
    slope = a * flow[1] + b * flow[2] + c * flow[3] + d * flow[4] + e * flow[5] + f * flow[6]
    x, y, z = ascent.centre
    return (a, b, c, d - (b * z - c * y), e - (c * x - a * z), f - (a * y - b * x)), slope


@inner
def _step(product, ascent, pose, xi, slope, climbers, n, places):
    """Move climber n by the best step found along the flow; whether it goes on from there."""
    before, most = climbers.value[n], ascent.most
    tau = max(climbers.step[n], ascent.least)
    other = 0.0
    at_other = 0.0
    value = product_at(product, _moved_along(pose, xi, tau), places)
    vertex = _vertex(tau, value - before, slope)
    while value > before and vertex > tau and tau < most:
        longer = min(2.0 * tau, most)
        beyond = product_at(product, _moved_along(pose, xi, longer), places)
        if not beyond > value:
            other, at_other = longer, beyond
            break
        other = tau
        at_other = value
        tau = longer
        value = beyond
        vertex = _vertex(tau, value - before, slope)
    while value <= before and tau > ascent.least / 1024.0:
        other, at_other = tau, value
        tau = max(min(vertex, 0.5 * tau), 0.1 * tau)
        value = product_at(product, _moved_along(pose, xi, tau), places)
        vertex = _vertex(tau, value - before, slope)
    if value <= before:
        return False
    ahead = _crest(tau, value - before, other, at_other - before, slope) if other > 0.0 else vertex
    for _ in range(_REFINEMENTS):
        if not (ahead <= most and abs(ahead - tau) > _NEAR * tau):
            break
        at_ahead = product_at(product, _moved_along(pose, xi, ahead), places)
        if at_ahead > value:
            tau, value, other, at_other = ahead, at_ahead, tau, value
        else:
            other, at_other = ahead, at_ahead
        ahead = _crest(tau, value - before, other, at_other - before, slope)
    reached = _moved_along(pose, xi, tau)
    for i in range(12):
        climbers.poses[n, i] = reached[i]
    small = value - before <= ascent.stop_below * before
    climbers.value[n], climbers.step[n] = value, tau
    climbers.stalled[n] = climbers.stalled[n] + 1 if small else 0
    return climbers.stalled[n] < _PATIENCE


@leaf
def _vertex(tau, gain, slope):
    """Return the top of the parabola of that slope at 0 and that gain at tau; infinite if none."""
    bend = (gain / tau - slope) / tau
    return -0.5 * slope / bend if bend < 0.0 else np.inf


@leaf
def _crest(tau, gain, other, other_gain, slope):
    """Return the nearest top of the cubic of that slope at 0 and those gains; infinite if none."""
    near, far = (gain / tau - slope) / tau, (other_gain / other - slope) / other
    third = (far - near) / (other - tau)
    second = near - third * tau
    root = second * second - 3.0 * third * slope
    below = np.sqrt(root) - second if root >= 0.0 else 0.0
    return slope / below if below > 0.0 else np.inf


@leaf
def _moved_along(pose, xi, tau):
    """Return G Exp(tau xi) of a pose G and a flow xi = (omega, u)."""
    size = np.sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    angle = tau * size
    inverse = 1.0 / size if size > 0.0 else 0.0
    a, b, c = xi[0] * inverse, xi[1] * inverse, xi[2] * inverse
    sine, cosine = sine_cosine(angle)
    half, _ = sine_cosine(0.5 * angle)
    back = 2.0 * half * half  # 1 - cos, which loses no digit of small angles
    u, v, w = xi[3], xi[4], xi[5]
    p, q, r = b * w - c * v, c * u - a * w, a * v - b * u
    i, j, k = b * r - c * q, c * p - a * r, a * q - b * p
    first = back / angle if angle > 0.0 else 0.0
    square, second = angle * angle, (angle - sine) / angle
    if angle < 0.02:  # where the difference would lose digits
        second = square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0))
    exponential = (
        cosine + back * a * a, back * a * b - sine * c, back * a * c + sine * b,
        back * a * b + sine * c, cosine + back * b * b, back * b * c - sine * a,
        back * a * c - sine * b, back * b * c + sine * a, cosine + back * c * c,
        tau * (u + first * p + second * i),
        tau * (v + first * q + second * j),
        tau * (w + first * r + second * k),
    )  # fmt: skip
    return composed(pose, exponential)


@inner
def flow_at(product, pose, centre, places):
    """Return F, sum x_i x h_i and sum h_i with h_i = R^T grad f(R x_i + t), x_i from the centre."""
    value = x = y = z = p = q = r = 0.0
    for term in product:
        xs, ys, zs = term.points[0], term.points[1], term.points[2]
        box, table = term.field.box, term.field.table
        m = term.weight
        f = gx = gy = gz = u = v = w = 0.0  # sums of f(p_i), grad f and p_i x grad f
        for first in range(0, len(xs), _POINTS):
            last = min(first + _POINTS, len(xs))
            x_of, y_of, z_of = xs[first:last], ys[first:last], zs[first:last]
            locate(pose, box, x_of, y_of, z_of, places, last - first)
            for n in range(last - first):
                if places.beyond[n] == 0.0:
                    i, j, k = places.u[n], places.v[n], places.w[n]
                    s, nx, ny, nz = distance_between_nodes(box, table, places.cell[n], i, j, k)
                    a, b, c = moved(pose, x_of[n], y_of[n], z_of[n])
                    f, gx, gy, gz = f + s, gx + nx, gy + ny, gz + nz
                    u, v, w = u + (b * nz - c * ny), v + (c * nx - a * nz), w + (a * ny - b * nx)
        value = value + m * f
        x = x + m * gx
        y = y + m * gy
        z = z + m * gz
        p, q, r = p + m * u, q + m * v, r + m * w
    # R (x_i x h_i) = (p_i - R c - t) x grad f(p_i)
    a, b, c = moved(pose, centre[0], centre[1], centre[2])
    p, q, r = p - (b * z - c * y), q - (c * x - a * z), r - (a * y - b * x)
    return (value, *turned_back(pose, p, q, r), *turned_back(pose, x, y, z))


@dataclass(frozen=True)
class Kernel:
    """k(x, z) = amplitude exp(-|x - z|^2 / (2 ell^2)), metres."""

    ell: float  # metres
    amplitude: float = 1.0  # k(x, x)

    def reach(self, spacing: float, stride: int = 1) -> int:
        """K: how many nodes it reaches, a multiple of the stride."""
        return -(-math.ceil(TRUNCATION * self.ell / spacing) // stride) * stride


class ClassField(NamedTuple):
    """f of one class of a cloud in the object frame."""

    box: Box  # of its nodes
    table: Any  # (4 nodes,), f and its gradient at each node of the box; float32
    values: Any  # (nodes,), f alone, so that fewer bytes are read; float32
    norm: float  # <f, f>


class ClassTerm(NamedTuple):
    """One class of points and its field."""

    points: FloatArray  # (3, N), world, metres
    field: ClassField  # f of the class
    weight: float = 1.0  # W of the class


Product = tuple[ClassTerm, ...]  # F(X) = sum over classes of W sum_i f(R x_i + t)


def values_of(product: Product, poses: FloatArray) -> FloatArray:
    """Return F (B,) at poses (B, 12)."""
    out = np.empty(len(poses))
    parallel_for(partial(_fill_values, product, poses, out), len(poses), scratch=_places)
    return out


@compiled
def _fill_values(product, poses, out, first, last, places):
    for n in range(first, last):
        out[n] = product_at(product, pose_at(poses, n), places)


@inner
def product_at(product, pose, places):
    """Return F at a pose."""
    total = 0.0
    for term in product:
        xs, ys, zs = term.points[0], term.points[1], term.points[2]
        box, values = term.field.box, term.field.values
        value = 0.0
        for first in range(0, len(xs), _POINTS):
            last = min(first + _POINTS, len(xs))
            x_of, y_of, z_of = xs[first:last], ys[first:last], zs[first:last]
            locate(pose, box, x_of, y_of, z_of, places, last - first)
            for n in range(last - first):
                if places.beyond[n] == 0.0:
                    value += _value_in_place(box, values, places, n)
        total += term.weight * value
    return total


@leaf
def _value_in_place(box, values, places, n):
    """Return f at the n-th place, interpolated between the values (nodes,) of its cell's nodes."""
    u, v = places.u[n], places.v[n]
    low, high = 1.0 - places.w[n], places.w[n]
    across, along = np.uint64(np.int64(box.across)), np.uint64(np.int64(box.along))
    at, next_node = np.uint64(places.cell[n]), np.uint64(1)
    a = low * values[at] + high * values[at + next_node]
    b = low * values[at + along] + high * values[at + along + next_node]
    at += across
    c = low * values[at] + high * values[at + next_node]
    d = low * values[at + along] + high * values[at + along + next_node]
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * d)


def class_field(sdf: SdfGrid, kernel: Kernel, *, band: float, name: str) -> ClassField:
    """Return nodes of a grid by class: "surface" within `band` metres of it, "free" beyond."""

    def make() -> ClassField:
        members = np.abs(sdf.values) <= band if name == "surface" else sdf.values > band
        spacing = sdf.resolution
        stride = max(1, math.floor(kernel.ell / (FINENESS * spacing) + 1e-9))
        reach = kernel.reach(spacing, stride)
        shape = [-(-(count - 1 + 2 * reach) // stride) + 1 for count in sdf.shape]
        source = members.astype(np.float64)
        table = np.empty((*shape, 4), dtype=np.float32)
        table[..., 0] = value = kernel.amplitude * _blurred(
            source, kernel, spacing=spacing, shape=shape, stride=stride
        )
        for axis in range(3):  # ell^2 grad f = sum k(., z) z - f p
            z, p = (np.ogrid[tuple(map(slice, counts))][axis] for counts in (sdf.shape, shape))
            moment = kernel.amplitude * _blurred(
                source * z, kernel, spacing=spacing, shape=shape, stride=stride
            )
            slope = moment - (p * stride - reach) * value
            table[..., axis + 1] = spacing / (kernel.ell * kernel.ell) * slope
        box = box_of(sdf.origin - reach * spacing, stride * spacing, shape=shape, between=True)
        values = table[..., 0].reshape(-1)
        made = ClassField(box, table.reshape(-1), values=values, norm=0.0)
        nodes = ClassTerm((sdf.origin + np.argwhere(members) * spacing).T.copy(), made)
        norm = values_of((nodes,), Poses.of(np.eye(4)[None]).numbers)
        return made._replace(norm=float(norm[0]))

    return sdf.derived(("rkhs", name, kernel, band), make)


def cloud_norm(points: FloatArray, kernel: Kernel, *, lattice: float) -> float:
    """Return <f, f> of a cloud (N, 3): the sum over all pairs.

    Many points on a lattice of that spacing, metres, are summed by a grid, unless it is too large.
    """
    reach = kernel.reach(lattice)
    nodes = _nodes_of(points, lattice)
    if nodes is None or math.prod((nodes.max(axis=0) + 1.0 + 2.0 * reach).tolist()) > MOST_NODES:
        return kernel.amplitude * _sum_of_pairs(points, kernel.ell)
    sides = [int(last) + 1 for last in nodes.max(axis=0)]
    grid = np.zeros(sides)
    np.add.at(grid, tuple(nodes.astype(np.int64).T), 1.0)
    around = [side + 2 * reach for side in sides]
    inside = tuple(slice(reach, reach + side) for side in sides)
    terms = (
        grid * _blurred(grid, kernel, spacing=lattice, shape=around, stride=1)[inside]
    ).reshape(-1)
    return kernel.amplitude * float(np.cumsum(terms)[-1])  # added in their order


@compiled
def _sum_of_pairs(points, ell):
    """Return sum over pairs of points (N, 3) of exp(-|x - y|^2 / (2 ell^2))."""
    total, radius = 0.0, _FAR * ell
    for i in range(len(points)):
        total += 1.0
        for j in range(i + 1, len(points)):
            x, y = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            z = points[i, 2] - points[j, 2]
            squared = x * x + y * y + z * z
            if squared < radius * radius:
                total += 2.0 * exp(-0.5 * squared / (ell * ell))
    return total


def _nodes_of(points: FloatArray, lattice: float) -> FloatArray | None:
    """Return indices (N, 3) of lattice nodes from the first on; None if few, or off the lattice."""
    if len(points) <= _FEW:
        return None
    steps = (points - points.min(axis=0)) / lattice
    nodes: FloatArray = np.rint(steps)
    return nodes if (np.abs(steps - nodes) < _ON_LATTICE).all() else None


def full_cubes(
    points: FloatArray, kernel: Kernel, *, lattice: float
) -> tuple[FloatArray, FloatArray, Kernel]:
    """Return points (N, 3) left alone, centres (C, 3) of full lattice cubes, a cube's kernel.

    A cube counts as one point of a kernel that is wider by the cube's variance: off by less than
    1e-3 of its sum, as its side is at most half of ell. Few points, or those off the lattice, have
    no cubes.
    """
    side = math.floor(0.5 * kernel.ell / lattice)
    nodes = _nodes_of(points, lattice) if side > 1 else None
    if nodes is None:
        return points, np.zeros((0, 3)), kernel
    low, cube, counts = np.unique(nodes // side, axis=0, return_inverse=True, return_counts=True)
    full = counts == side**3
    centres = (low[full] * side + (side - 1) / 2.0) * lattice + points.min(axis=0)
    ell = math.sqrt(kernel.ell * kernel.ell + lattice * lattice * (side * side - 1) / 12.0)
    ratio = kernel.ell / ell
    wide = Kernel(ell, kernel.amplitude * (side**3 * ratio * ratio * ratio))
    return points[~full[cube.reshape(-1)]], centres, wide


def _blurred(
    source: FloatArray, kernel: Kernel, *, spacing: float, shape: list[int], stride: int
) -> FloatArray:
    """Return a source (nx, ny, nz) blurred without amplitude, at each `stride`-th node from -K."""
    reach = kernel.reach(spacing, stride)
    x = np.arange(-reach, reach + 1) * spacing / kernel.ell
    weights = exps(-0.5 * x * x)
    for axis in (2, 1, 0):
        before = source.shape[:axis]
        after = source.shape[axis + 1 :]
        rows = source.reshape(math.prod(before), source.shape[axis], math.prod(after))
        out = np.empty((len(rows), shape[axis], rows.shape[2]))
        parallel_for(
            partial(_blur_rows, rows, weights, stride, out), shape[axis], scratch=lambda: None
        )
        source = out.reshape(*before, shape[axis], *after)
    return source


@compiled
def _blur_rows(source, weights, stride, out, first, last, _):
    """Fill rows `first` to before `last` of out (A, m, C), from row o stride - K of the source."""
    reach = len(weights) // 2
    across, rows, along = source.shape
    for a in range(across):
        for o in range(first, last):
            at = o * stride - reach
            target = out[a, o]
            target[:] = 0.0
            for s in range(max(at - reach, 0), min(at + reach + 1, rows)):
                weight = weights[at - s + reach]
                line = source[a, s]
                for c in range(along):
                    target[c] += weight * line[c]
