"""CVO: ascent of the inner product of two labelled clouds (baseline of the paper).

After Clark, Ghaffari et al. (2021) and Zhang, Ghaffari et al. (2021), with two classes: free
space and surface. Of the cloud in the object frame only its fields are left, see `rkhs_fields`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.methods.cvo.rkhs_fields import (
    Kernel,
    Product,
    cloud_norm,
    free_field,
    full_cubes,
    moments_at,
    product_at,
    surface_field,
    values_of,
)
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import sine_cosine
from chsel.numerics.pose_tuples import Triple, composed, moved, pose_at, turned_back
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import COARSEST, FINEST
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

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        require_ieee_arithmetic()
        observer = observer or NullObserver()
        settings, estimates = self.settings, Poses.of(problem.initial_set)
        centre = np.zeros(3)
        if settings.origin == "workspace":
            centre = (problem.workspace.bounds[0] + problem.workspace.bounds[1]) / 2.0
        poses, stop_below = estimates.numbers, settings.stop_below
        ascent = Ascent(
            least=settings.min_step,
            most=settings.max_step,
            centre=triple(centre),
            c=settings.c,
            d=settings.d,
            stop_below=-1.0 if stop_below is None else stop_below,
        )
        total = settings.max_iterations * len(settings.levels)
        ends = [*range(0, settings.max_iterations, _BLOCK), settings.max_iterations]
        for level, ell in enumerate(settings.levels):
            product, norm = self._clouds(problem, ell)
            climbers = climbers_at(poses, values_of(product, poses))
            if level == 0:
                observer.trace("ascent", 0, estimates.vectors, _costs(climbers.value, norm))
            for first, last in pairwise(ends):
                run = partial(climb, product, ascent, climbers, last - first)
                spread(run, len(poses), lambda: None)
                estimates = Poses(climbers.poses.copy())
                done = level * settings.max_iterations + last
                observer.trace("ascent", done, estimates.vectors, _costs(climbers.value, norm))
                observer.progress("ascent", done, total)
                if climbers.done.all():
                    break
            poses = climbers.poses
        return ranked(estimates.matrices, _costs(climbers.value, norm))

    def _clouds(self, problem: RegistrationProblem, ell: float) -> tuple[Product, float]:
        """F, and |f_x| |f_z|."""
        settings, sdf, kernel = self.settings, problem.sdf, Kernel(ell)
        lattice = problem.free_resolution
        band = sdf.resolution if settings.surface_band is None else settings.surface_band
        contacts = problem.points.contacts
        free = problem.points.free if settings.free_space else np.zeros((0, 3))
        surface_z = surface_field(sdf, kernel, band)
        free_z = free_field(sdf, kernel, band) if settings.free_space else surface_z
        weight = 1.0
        if settings.balanced and len(contacts) and len(free):
            weight = len(free) / len(contacts)
        observed = weight * cloud_norm(contacts, kernel, lattice)
        of_object = weight * surface_z.norm
        if settings.free_space:
            observed += cloud_norm(free, kernel, lattice)
            of_object += free_z.norm
        alone, cubes, wide = full_cubes(free, kernel, lattice)
        cube_z = free_field(sdf, wide, band) if len(cubes) else free_z
        product = Product(
            free=free_z.term(alone, 1.0),
            cubes=cube_z.term(cubes, 1.0),
            surface=surface_z.term(contacts, weight),
        )
        return product, float(np.sqrt(observed * of_object))


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
