"""CVO: ascent of the inner product of two labelled clouds (baseline of the paper).

After Clark, Ghaffari et al. (2021) and Zhang, Ghaffari et al. (2021), with two classes: free
space and surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Annotated, ClassVar

import numpy as np

from chsel.errors import SettingError
from chsel.methods.cvo.cvo_kernels import (
    STEPS,
    Ascent,
    Product,
    climb,
    climbers_at,
    products,
)
from chsel.methods.cvo.field_kernels import scratch
from chsel.methods.cvo.gaussian_blur import Kernel
from chsel.methods.cvo.rkhs_fields import (
    cloud_norm,
    cube_kernel,
    free_field,
    full_cubes,
    surface_field,
)
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.elementary import exp, log
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses, rotated
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
    # Amplitudes of the kernels of places and of equal labels; unequal labels have a kernel of 0.
    sigma: Annotated[float, positive] = 0.1
    s_sigma: Annotated[float, positive] = 0.8
    sp_thres: Annotated[float, not_negative] = 0.0  # products of kernels up to it count as 0
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
        "reference": {
            **_AUTHORS,
            "sp_thres": 6e-4,
            "surface_band": 0.005,
            "online": {"update": "own"},
        },
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sp_thres < self.amplitude:
            raise SettingError(
                f"sp_thres is {self.sp_thres}; accepted: below sigma^2 s_sigma^2 = {self.amplitude}"
            )
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
    def amplitude(self) -> float:
        """The kernel of a point with itself."""
        return self.sigma * self.sigma * self.s_sigma * self.s_sigma

    @property
    def levels(self) -> list[float]:
        """The length scales of the ascents, metres."""
        levels = [self.ell]
        while levels[-1] > self.ell_min * (1.0 + 1e-9) and len(levels) <= MOST_LEVELS:
            levels.append(max(levels[-1] * self.ell_decay, self.ell_min))
        return levels


@dataclass(frozen=True, eq=False)
class _Clouds:
    """The clouds of a problem at one length scale."""

    product: Product
    norm: float  # |f_x| |f_z|

    def values(self, poses: FloatArray) -> FloatArray:
        """F (B,) at poses (B, 12)."""
        out = np.empty(len(poses))
        spread(partial(products, self.product, poses, out), len(poses), scratch)
        return out

    def costs(self, values: FloatArray) -> FloatArray:
        """1 - F / (|f_x| |f_z|), in [0, 1] but for the field's interpolation."""
        return 1.0 - values / self.norm if self.norm > 0.0 else np.ones(len(values))


class Cvo(ConfiguredMethod[CvoSettings]):
    """Climbs the inner product of two clouds from every pose of E_0; E_l is not used.

    The observed cloud x: free points, and contacts; the object's z: nodes of the SDF grid within
    surface_band of the surface, and those farther outside. F(X) = sum_ij a(R x_i + t, z_j) over
    pairs of one class, with a = exp(-|x - z|^2 / (2 ell^2)), in units of sigma^2 s_sigma^2. Cost:
    1 - F / (|f_x| |f_z|), 1 minus the cosine between the clouds as functions, at the last ell; 1
    where they do not meet. Such a start stays where it is, as does all of E_0 if there is no point
    to use. Occupied points and points of a known distance that is not 0 are not used. A trace has
    the costs at the ell of its ascent.
    """

    settings_class = CvoSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        require_ieee_arithmetic()
        observer = observer or NullObserver()
        settings, points = self.settings, problem.points
        initial = estimates = Poses.of(problem.initial_set)
        if len(points.contacts) == 0 and not (settings.free_space and len(points.free)):
            costs = np.ones(len(estimates))
            observer.trace("ascent", 0, estimates.vectors, costs.copy())
            return ranked(estimates.matrices, costs)
        centre = np.zeros(3)
        if settings.origin == "workspace":
            centre = (problem.workspace.bounds[0] + problem.workspace.bounds[1]) / 2.0
        poses, ascent = _seen_from(centre, initial).numbers, self._ascent()
        moved = np.zeros(len(poses), dtype=bool)
        total = settings.max_iterations * len(settings.levels)
        ends = [*range(0, settings.max_iterations, _BLOCK), settings.max_iterations]
        for level, ell in enumerate(settings.levels):
            clouds = self._clouds(problem, ell, centre)
            climbers = climbers_at(poses, clouds.values(poses))
            if level == 0:
                observer.trace("ascent", 0, estimates.vectors, clouds.costs(climbers.value))
            for first, last in pairwise(ends):
                run = partial(climb, clouds.product, ascent, climbers, last - first)
                spread(run, len(poses), scratch)
                moved |= climbers.moved
                estimates = _in_world(climbers.poses, moved, centre, initial)
                done = level * settings.max_iterations + last
                observer.trace("ascent", done, estimates.vectors, clouds.costs(climbers.value))
                observer.progress("ascent", done, total)
                if climbers.done.all():
                    break
            poses = climbers.poses
        return ranked(estimates.matrices, clouds.costs(climbers.value))

    def _ascent(self) -> Ascent:
        """The settings of `climb`; steps grow by a fixed factor."""
        settings = self.settings
        growth = log(settings.max_step / settings.min_step) / (STEPS - 1)
        steps = np.array([settings.min_step * exp(growth * k) for k in range(STEPS)])
        stop_below = -1.0 if settings.stop_below is None else settings.stop_below
        return Ascent(np.minimum(steps, settings.max_step), settings.c, settings.d, stop_below)

    def _clouds(self, problem: RegistrationProblem, ell: float, centre: FloatArray) -> _Clouds:
        """Both clouds; the observed one as seen from `centre` (3,)."""
        settings, sdf, lattice = self.settings, problem.sdf, problem.free_resolution
        kernel = Kernel.above(ell, 1.0, settings.sp_thres / settings.amplitude)
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
        alone, cubes, cube_z = free, np.zeros((0, 3)), free_z
        if settings.sp_thres == 0.0:
            alone, cubes, side = full_cubes(free, ell, lattice)
            if side > 1:
                cube_z = free_field(sdf, cube_kernel(kernel, lattice, side), band)
        product = Product(
            free=free_z.term(alone - centre, 1.0),
            cubes=cube_z.term(cubes - centre, 1.0),
            surface=surface_z.term(contacts - centre, weight),
        )
        return _Clouds(product, float(np.sqrt(observed * of_object)))


def _seen_from(centre: FloatArray, poses: Poses) -> Poses:
    """The same poses in a world whose origin is at `centre` (3,)."""
    shifted = poses.translations + rotated(poses.rotations, centre)
    return Poses(np.concatenate([poses.numbers[:, :9], shifted], axis=1))


def _in_world(poses: FloatArray, moved: BoolArray, centre: FloatArray, initial: Poses) -> Poses:
    """Poses (B, 12) seen from `centre` (3,) back in the world; of E_0 those that never moved."""
    back = _seen_from(-centre, Poses(poses))
    return Poses(np.where(moved[:, None], back.numbers, initial.numbers))
