"""CVO: ascent of the inner product of two labelled clouds (baseline of the paper).

After Clark, Ghaffari et al. (2021) and Zhang, Ghaffari et al. (2021), with two classes: free
space and surface. Clouds are functions f = sum_j k(., z_j) of a reproducing kernel Hilbert space.
Of the object's cloud, nodes of its SDF, f becomes a table on a grid; of the observed cloud the norm
alone is needed, and cubes of free points in place of the points, which are many. Numbers of a table
are of 32 bits, sums of 64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Box, box_of, triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, exps, sine_cosine
from chsel.numerics.pose_tuples import Triple, composed, moved, pose_at, turned_back
from chsel.numerics.threads import parallel_for
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.sdf_grid import COARSEST, FINEST, SdfGrid
from chsel.problem.sdf_lookup import cell_of, distance_between_nodes, value_between_nodes
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
MOST_LEVELS = 20
_BLOCK = 10  # iterations between two traces
_PATIENCE = 5
_REFINEMENTS = 3
_NEAR = 0.05  # steps count as equally long if they differ by less than this fraction
MOST_NODES = 30_000_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them
TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_FEW = 2000  # points that are taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_SNAPPED_FINENESS = 4  # nodes per ell that points are moved to
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


@dataclass(frozen=True)
class CvoSettings(CheckedSettings):
    """All settings of CVO; names as in the authors' parameter file."""

    free_space: bool = True  # use free points; else contacts and the object's surface alone
    balanced: bool = False  # weigh contacts by the number of free points per contact
    # Length scale of the kernel, metres. After an ascent it is multiplied by ell_decay and another
    # ascent follows, as long as it is above ell_min.
    ell: Annotated[float, positive, between(FINEST, COARSEST)] = 0.1
    ell_min: Annotated[float, positive, between(FINEST, COARSEST)] = 0.025
    ell_decay: Annotated[float, positive] = 0.5
    # Nodes of the SDF within it of the surface make the object's surface, those farther outside its
    # free space, metres; null: the SDF's resolution (r_t).
    surface_band: Annotated[float | None, positive] = None
    # Divisors of the rotational and the translational part of the flow, so that a turn by 1 rad
    # counts as a shift by sqrt(c / d) m.
    c: Annotated[float, positive] = 0.07
    d: Annotated[float, positive] = 7.0
    # The flow turns about the workspace's centre, or the "world" origin as published.
    origin: Annotated[str, one_of("world", "workspace")] = "workspace"
    max_iterations: Annotated[int, positive, at_most(MOST_ITERATIONS)] = 100  # of an ascent
    min_step: Annotated[float, positive] = 1e-4  # the least and
    max_step: Annotated[float, positive] = 0.8  # the greatest length of a step that is tried first
    # A start ends when its inner product grew by no more than this fraction in 5 iterations in a
    # row; null: never.
    stop_below: Annotated[float | None, not_negative] = 1e-5
    online: OnlineSettings = field(default_factory=OnlineSettings)

    _AUTHORS: ClassVar = {"ell_min": 0.1, "c": 7.0, "origin": "world", "stop_below": None}
    presets: ClassVar[Presets] = {
        "paper": _AUTHORS,
        "reference": {**_AUTHORS, "surface_band": 0.005, "online": {"update": "own"}},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_step <= self.max_step <= 1.0:
            raise SettingError(
                f"min_step is {self.min_step} and max_step {self.max_step}; accepted: min_step at "
                "most max_step, max_step at most 1"
            )
        if not self.ell_decay < 1.0:
            raise SettingError(f"ell_decay is {self.ell_decay}; accepted: above 0 and below 1")
        if len(self.levels) > MOST_LEVELS:
            raise SettingError(
                f"ell {self.ell}, ell_decay {self.ell_decay} and ell_min {self.ell_min} make more "
                f"than {MOST_LEVELS} ascents; accepted: at most {MOST_LEVELS}"
            )

    @property
    def levels(self) -> list[float]:
        """The length scales of the ascents, metres."""
        levels = [self.ell]
        while levels[-1] > self.ell_min * (1.0 + 1e-9) and len(levels) <= MOST_LEVELS:
            levels.append(max(levels[-1] * self.ell_decay, self.ell_min))
        return levels


class Cvo(ConfiguredMethod[CvoSettings]):
    """Climbs the inner product of two clouds from every pose of E_0; E_l is not used.

    The observed cloud x: free points, and contacts; the object's z: nodes of the SDF grid within
    surface_band of the surface, and those farther outside. F(X) = sum_ij a(R x_i + t, z_j) over
    pairs of one class, as that of unequal labels is 1e-28 of it, with a = exp(-|x - z|^2 / (2
    ell^2)). Cost: 1 - F / (|f_x| |f_z|), 1 minus the cosine between the clouds as functions, at the
    last ell; 1 where they do not meet. Such a start stays where it is, as does all of E_0 if there
    is no point to use. Occupied points and points of a known distance that is not 0 are not used. A
    trace has the costs at the ell of its ascent.
    """

    settings_class = CvoSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        settings, estimates = self.settings, Poses.of(problem.initial_set)
        poses, centre = estimates.numbers, np.zeros(3)
        if settings.origin == "workspace":
            centre = (problem.workspace.bounds[0] + problem.workspace.bounds[1]) / 2.0
        ascent = Ascent(
            least=settings.min_step,
            most=settings.max_step,
            centre=triple(centre),
            c=settings.c,
            d=settings.d,
            stop_below=-1.0 if settings.stop_below is None else settings.stop_below,
        )
        total = settings.max_iterations * len(settings.levels)
        ends = [*range(0, settings.max_iterations, _BLOCK), settings.max_iterations]
        for level, ell in enumerate(settings.levels):
            product, norm = self._clouds(problem, Kernel(ell))
            climbers = climbers_at(poses, values_of(product, poses))
            if level == 0:
                observer.trace("ascent", 0, estimates.vectors, _costs(climbers.value, norm))
            for first, last in pairwise(ends):
                run = partial(climb, product, ascent, climbers, last - first)
                parallel_for(run, len(poses), lambda: None)
                estimates = Poses(climbers.poses.copy())
                done = level * settings.max_iterations + last
                observer.trace("ascent", done, estimates.vectors, _costs(climbers.value, norm))
                observer.progress("ascent", done, total)
                if climbers.done.all():
                    break
            poses = climbers.poses
        return ranked(estimates.matrices, _costs(climbers.value, norm))

    def _clouds(self, problem: RegistrationProblem, kernel: Kernel) -> tuple[Product, float]:
        """F, and |f_x| |f_z|."""
        sdf, lattice, contacts = problem.sdf, problem.free_resolution, problem.points.contacts
        band = self.settings.surface_band or sdf.resolution
        free = problem.points.free if self.settings.free_space else np.zeros((0, 3))
        weight = 1.0
        if self.settings.balanced and len(contacts) and len(free):
            weight = len(free) / len(contacts)
        surface_z = class_field(sdf, kernel, band, "surface")
        observed = weight * cloud_norm(contacts, kernel, lattice)
        of_object = weight * surface_z.norm
        terms = [surface_z.term(contacts, weight)]
        if self.settings.free_space:
            free_z = class_field(sdf, kernel, band, "free")
            observed += cloud_norm(free, kernel, lattice)
            of_object += free_z.norm
            alone, cubes, wide = full_cubes(free, kernel, lattice)
            cube_z = class_field(sdf, wide, band, "free") if len(cubes) else free_z
            terms = [free_z.term(alone, 1.0), cube_z.term(cubes, 1.0), *terms]
        return tuple(terms), float(np.sqrt(observed * of_object))


def _costs(values: FloatArray, norm: float) -> FloatArray:
    """1 - F / (|f_x| |f_z|), in [0, 1] but for the field's interpolation."""
    return 1.0 - values / norm if norm > 0.0 else np.ones(len(values))


class Ascent(NamedTuple):
    """How to climb."""

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


def climbers_at(poses: FloatArray, value: FloatArray) -> Climbers:
    """Climbers at copies of poses (B, 12) with their F (B,), before the first step."""
    step, stalled = np.zeros(len(poses)), np.zeros(len(poses), dtype=np.int64)
    return Climbers(poses.copy(), value.copy(), step, stalled, np.zeros(len(poses), dtype=bool))


@compiled
def climb(product, ascent, climbers, iterations, first, last, _):
    """Move climbers uphill for some iterations, those from `first` to before `last`."""
    for n in range(first, last):
        for _ in range(iterations):
            if not climbers.done[n]:
                pose = pose_at(climbers.poses, n)
                xi, slope = _direction(product, ascent, pose)
                if slope > 0.0:
                    _step(product, ascent, pose, xi, slope, climbers, n)
                else:
                    climbers.done[n] = True


@inner
def _direction(product, ascent, pose):
    """The flow xi = (omega, u), and the slope of F along it; 0 without overlap.

    omega = 1/c sum x_i x h_i, u = 1/d sum h_i, made a unit vector, with x_i from the centre; then u
    is that of the same flow about the world's origin.
    """
    flow = flow_at(product, pose, ascent.centre)
    a, b, c = flow[1] / ascent.c, flow[2] / ascent.c, flow[3] / ascent.c
    d, e, f = flow[4] / ascent.d, flow[5] / ascent.d, flow[6] / ascent.d
    size = np.sqrt(a * a + b * b + c * c + d * d + e * e + f * f)
    if not 0.0 < size < np.inf:
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0
    xi = a / size, b / size, c / size, d / size, e / size, f / size
    slope = 0.0
    for i in range(6):
        slope += xi[i] * flow[i + 1]
    a, b, c, d, e, f = xi
    x, y, z = ascent.centre
    return (a, b, c, d - (b * z - c * y), e - (c * x - a * z), f - (a * y - b * x)), slope


@inner
def _step(product, ascent, pose, xi, slope, climbers, n):
    """Move climber n by the best step found along the flow, if any is uphill.

    From the last step's length on: longer while F rises, or shorter until it has risen; then where
    polynomials are highest that have F and its slope at 0, and F at the lengths tried.
    """
    before, most = climbers.value[n], ascent.most
    tau, other, at_other = max(climbers.step[n], ascent.least), 0.0, 0.0
    value = product_at(product, _moved_along(pose, xi, tau))
    vertex = _vertex(tau, value - before, slope)
    while value > before and vertex > tau and tau < most:
        longer = min(2.0 * tau, most)
        beyond = product_at(product, _moved_along(pose, xi, longer))
        if not beyond > value:
            other, at_other = longer, beyond
            break
        other, at_other, tau, value = tau, value, longer, beyond
        vertex = _vertex(tau, value - before, slope)
    while value <= before and tau > ascent.least / 1024.0:
        other, at_other = tau, value
        tau = max(min(vertex, 0.5 * tau), 0.1 * tau)
        value = product_at(product, _moved_along(pose, xi, tau))
        vertex = _vertex(tau, value - before, slope)
    if value <= before:
        climbers.done[n] = True
        return
    ahead = vertex
    if other > 0.0:
        ahead = _crest(tau, value - before, other, at_other - before, slope)
    for _ in range(_REFINEMENTS):
        if not (ahead <= most and abs(ahead - tau) > _NEAR * tau):
            break
        at_ahead = product_at(product, _moved_along(pose, xi, ahead))
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
    climbers.done[n] = climbers.stalled[n] >= _PATIENCE


@leaf
def _vertex(tau, gain, slope):
    """Where a parabola of that slope at 0 and that gain at tau is highest; infinite if nowhere."""
    bend = (gain / tau - slope) / tau
    return -0.5 * slope / bend if bend < 0.0 else np.inf


@leaf
def _crest(tau, gain, other, other_gain, slope):
    """Where a cubic of that slope at 0 and those gains is highest nearby; infinite if nowhere."""
    near, far = (gain / tau - slope) / tau, (other_gain / other - slope) / other
    third = (far - near) / (other - tau)
    second = near - third * tau
    root = second * second - 3.0 * third * slope
    below = np.sqrt(root) - second if root >= 0.0 else 0.0
    return slope / below if below > 0.0 else np.inf


@leaf
def _moved_along(pose, xi, tau):
    """G Exp(tau xi) of a pose G = (R, t) and a flow xi = (omega, u).

    Exp has the rotation I + sin(a) W + (1 - cos(a)) W^2, a = tau |omega|, W the hat of omega /
    |omega|, and the translation tau (u + (1 - cos a)/a W u + (a - sin a)/a W^2 u).
    """
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
    second = _rest_of_sine(angle, sine)
    exponential = (
        cosine + back * a * a,
        back * a * b - sine * c,
        back * a * c + sine * b,
        back * a * b + sine * c,
        cosine + back * b * b,
        back * b * c - sine * a,
        back * a * c - sine * b,
        back * b * c + sine * a,
        cosine + back * c * c,
        tau * (u + first * p + second * i),
        tau * (v + first * q + second * j),
        tau * (w + first * r + second * k),
    )
    return composed(pose, exponential)


@leaf
def _rest_of_sine(angle, sine):
    """(a - sin a) / a; by its series where the difference would lose digits."""
    if angle < 0.02:
        square = angle * angle
        return square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0))
    return (angle - sine) / angle


@inner
def flow_at(product, pose, centre):
    """F, sum x_i x h_i and sum h_i with h_i = R^T grad f(R x_i + t), x_i from the centre."""
    value = x = y = z = p = q = r = 0.0
    for term in product:
        f, gx, gy, gz, a, b, c = moments_at(term, pose)
        value, x, y, z = value + f, x + gx, y + gy, z + gz
        p, q, r = p + a, q + b, r + c
    # R (x_i x h_i) = (p_i - R c - t) x grad f(p_i)
    a, b, c = moved(pose, centre[0], centre[1], centre[2])
    p, q, r = p - (b * z - c * y), q - (c * x - a * z), r - (a * y - b * x)
    return (value, *turned_back(pose, p, q, r), *turned_back(pose, x, y, z))


@dataclass(frozen=True)
class Kernel:
    """k(x, z) = amplitude exp(-|x - z|^2 / (2 ell^2)), metres."""

    ell: float
    amplitude: float = 1.0

    def widened(self, variance: float, mass: float = 1.0) -> Kernel:
        """Spread by that variance along each axis, m^2, which may be negative; `mass` of them."""
        ell = math.sqrt(self.ell * self.ell + variance)
        ratio = self.ell / ell
        return Kernel(ell, self.amplitude * (mass * ratio * ratio * ratio))

    def reach(self, spacing: float, stride: int = 1) -> int:
        """K: how many nodes it reaches, a multiple of the stride."""
        nodes = math.ceil(TRUNCATION * self.ell / spacing)
        return -(-nodes // stride) * stride

    def weights(self, spacing: float, reach: int) -> FloatArray:
        """exp(-x^2 / (2 ell^2)) at x = -K .. K spacings (2 K + 1,)."""
        x = np.arange(-reach, reach + 1) * spacing
        return exps(-0.5 * (x / self.ell) * (x / self.ell))


class ClassTerm(NamedTuple):
    """One class of points and its field."""

    points: FloatArray  # (3, N), world, metres
    box: Box
    table: Any  # (4 nodes,), f and its gradient at each node of the box; float32
    weight: float  # W of the class


Product = tuple[ClassTerm, ...]
"""F(X) = sum over classes of W sum_i f(R x_i + t)."""


def values_of(product: Product, poses: FloatArray) -> FloatArray:
    """F (B,) at poses (B, 12)."""
    out = np.empty(len(poses))
    parallel_for(partial(_fill_values, product, poses, out), len(poses), lambda: None)
    return out


@compiled
def _fill_values(product, poses, out, first, last, _):
    """Fill out (B,) with F at poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = product_at(product, pose_at(poses, n))


@inner
def product_at(product, pose):
    """F at a pose."""
    total = 0.0
    for term in product:
        total += _sum_at(term, pose)
    return total


@inner
def _sum_at(term, pose):
    """W times the sum of f(p_i), p_i = R x_i + t; 0 beyond the field."""
    points, total = term.points, 0.0
    for n in range(points.shape[1]):
        a, b, c = moved(pose, points[0, n], points[1, n], points[2, n])
        cell, is_beyond = cell_of(term.box, a, b, c)
        if not is_beyond:
            total += value_between_nodes(term.table, *cell)
    return term.weight * total


@inner
def moments_at(term, pose):
    """W times sums of f, grad f and p x grad f at p_i = R x_i + t, in the object frame."""
    points, table, m = term.points, term.table, term.weight
    value = gx = gy = gz = p = q = r = 0.0
    for n in range(points.shape[1]):
        a, b, c = moved(pose, points[0, n], points[1, n], points[2, n])
        (at, _, _, u, v, w), is_beyond = cell_of(term.box, a, b, c)
        if not is_beyond:
            s, nx, ny, nz = distance_between_nodes(term.box, table, at, u, v, w)
            value += s
            gx, gy, gz = gx + nx, gy + ny, gz + nz
            p, q, r = p + (b * nz - c * ny), q + (c * nx - a * nz), r + (a * ny - b * nx)
    return m * value, m * gx, m * gy, m * gz, m * p, m * q, m * r


@dataclass(frozen=True, eq=False)
class ClassField:
    """f of one class of a cloud in the object frame."""

    box: Box
    table: Any  # (4 nodes,), see ClassTerm
    norm: float  # <f, f>

    def term(self, points: FloatArray, weight: float) -> ClassTerm:
        """Its part of F, for points (N, 3) of the same class in the world."""
        return ClassTerm(points.T.copy(), self.box, self.table, weight)


def class_field(sdf: SdfGrid, kernel: Kernel, band: float, name: str) -> ClassField:
    """Of nodes of a grid: "surface" within `band` metres of it, "free" more than that outside."""

    def make() -> ClassField:
        members = np.abs(sdf.values) <= band if name == "surface" else sdf.values > band
        return _class_field(sdf, members, kernel)

    return sdf.derived(("rkhs", name, kernel, band), make)


def _class_field(sdf: SdfGrid, members: BoolArray, kernel: Kernel) -> ClassField:
    """Of the nodes with a flag (nx, ny, nz)."""
    spacing = sdf.resolution
    stride = max(1, math.floor(kernel.ell / (FINENESS * spacing) + 1e-9))
    reach = kernel.reach(spacing, stride)
    shape = [-(-(count - 1 + 2 * reach) // stride) + 1 for count in sdf.shape]
    source, table = members.astype(np.float64), np.empty((*shape, 4), dtype=np.float32)
    table[..., 0] = value = kernel.amplitude * _blurred(source, kernel, spacing, shape, stride)
    for axis in range(3):  # ell^2 grad f = sum k(., z) z - f p
        z, p = (np.ogrid[tuple(map(slice, counts))][axis] for counts in (sdf.shape, shape))
        moment = kernel.amplitude * _blurred(source * z, kernel, spacing, shape, stride)
        slope = moment - (p * stride - reach) * value
        table[..., axis + 1] = spacing / (kernel.ell * kernel.ell) * slope
    box = box_of(sdf.origin - reach * spacing, stride * spacing, shape, between=True)
    field = ClassField(box, table.reshape(-1), 0.0)
    nodes = sdf.origin + np.argwhere(members) * spacing
    norm = values_of((field.term(nodes, 1.0),), Poses.of(np.eye(4)[None]).numbers)
    return replace(field, norm=float(norm[0]))


def cloud_norm(points: FloatArray, kernel: Kernel, lattice: float) -> float:
    """<f, f> of a cloud (N, 3): the sum over all pairs, one by one if they are few.

    Of more, the sum over a grid: of spacing `lattice`, metres, if every point is at a node, which
    is as exact as a field; else of a quarter of ell, with points moved to the nearest nodes,
    within 1 %. Points that span too large a grid are taken one by one, too.
    """
    pairs_within = _FAR * kernel.ell
    if len(points) <= _FEW:
        return kernel.amplitude * _sum_of_pairs(points, kernel.ell, pairs_within)
    spacing, narrow, nodes = lattice, kernel, _nodes_of(points, lattice)
    if nodes is None:
        spacing = kernel.ell / _SNAPPED_FINENESS
        narrow = kernel.widened(-spacing * spacing / 6.0)  # either point moves by half of it
        nodes = np.rint((points - points.min(axis=0)) / spacing)
    reach, most = narrow.reach(spacing), nodes.max(axis=0)
    if not math.prod((most + 1.0 + 2.0 * reach).tolist()) <= MOST_NODES:
        return kernel.amplitude * _sum_of_pairs(points, kernel.ell, pairs_within)
    sides = [int(last) + 1 for last in most]
    grid = np.zeros(sides)
    np.add.at(grid, tuple(nodes.astype(np.int64).T), 1.0)
    around = [side + 2 * reach for side in sides]
    inside = tuple(slice(reach, reach + side) for side in sides)
    terms = (grid * _blurred(grid, narrow, spacing, around, 1)[inside]).reshape(-1)
    return narrow.amplitude * float(np.cumsum(terms)[-1])  # added in their order


@compiled
def _sum_of_pairs(points: FloatArray, ell: float, radius: float) -> float:
    """Sum over pairs of points (N, 3) closer than `radius` of exp(-|x - y|^2 / (2 ell^2)).

    Of every point with itself and, twice, with those after it.
    """
    total = 0.0
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
    """Indices (N, 3) of lattice nodes from the first on, or None if points are elsewhere."""
    steps = (points - points.min(axis=0)) / lattice
    nodes: FloatArray = np.rint(steps)
    return nodes if (np.abs(steps - nodes) < _ON_LATTICE).all() else None


def full_cubes(
    points: FloatArray, kernel: Kernel, lattice: float
) -> tuple[FloatArray, FloatArray, Kernel]:
    """Points (N, 3) left alone, centres (C, 3) of full cubes of lattice points, a cube's kernel.

    A cube counts as one point of a wider kernel, which has the variance of the kernel and of the
    cube together, and differs in fourth moments: by less than 1e-3 of the cube's sum, as its side
    is at most half of ell. A cloud of few points, or off the lattice, has no cubes.
    """
    side = math.floor(0.5 * kernel.ell / lattice)
    nodes = _nodes_of(points, lattice) if len(points) > _FEW and side > 1 else None
    if nodes is None:
        return points, np.zeros((0, 3)), kernel
    corners, cube, counts = np.unique(
        nodes // side, axis=0, return_inverse=True, return_counts=True
    )
    full = counts == side**3
    centres = (corners[full] * side + (side - 1) / 2.0) * lattice + points.min(axis=0)
    wide = kernel.widened(lattice * lattice * (side * side - 1) / 12.0, side**3)
    return points[~full[cube.reshape(-1)]], centres, wide


def _blurred(
    source: FloatArray, kernel: Kernel, spacing: float, shape: list[int], stride: int
) -> FloatArray:
    """A source (nx, ny, nz) blurred, without the amplitude, at nodes of `shape` (3,).

    These lie every `stride` nodes of the source, the first K nodes before its first.
    """
    weights = kernel.weights(spacing, kernel.reach(spacing, stride))
    for axis in (2, 1, 0):
        before, after = source.shape[:axis], source.shape[axis + 1 :]
        rows = source.reshape(math.prod(before), source.shape[axis], math.prod(after))
        out = np.empty((len(rows), shape[axis], rows.shape[2]))
        parallel_for(partial(_blur_rows, rows, weights, stride, out), shape[axis], lambda: None)
        source = out.reshape(*before, shape[axis], *after)
    return source


@compiled
def _blur_rows(source, weights, stride, out, first, last, _):
    """Fill out (A, m, C), from row `first` to before `last`, with source (A, n, C) blurred.

    Row o of the result is at row o stride - K of the source. Rows add up in their order.
    """
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
