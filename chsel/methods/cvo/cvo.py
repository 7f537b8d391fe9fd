"""CVO: ascent of the inner product of two labelled clouds (baseline of the paper).

After Clark, Ghaffari et al. (2021) and Zhang, Ghaffari et al. (2021), with two classes: free
space and surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import ClassVar

import numpy as np

from chsel.errors import SettingError, require_at_most, require_choice, require_positive
from chsel.methods.cvo.cvo_kernels import (
    DONE,
    MOVED,
    STEPS,
    VALUE,
    Ascent,
    Product,
    climb,
    products,
    scratch,
)
from chsel.methods.cvo.rkhs_fields import (
    Kernel,
    blocks_of,
    cloud_norm,
    free_field,
    of_block,
    surface_field,
)
from chsel.numerics.arrays import FloatArray
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
from chsel.problem.settings import Presets
from chsel.qd.selection import ranked

MOST_ITERATIONS = 1_000_000
MOST_LEVELS = 20
_BLOCK = 10  # iterations between two traces


@dataclass(frozen=True)
class CvoSettings:
    """All settings of CVO; names as in the authors' parameter file.

    free_space: use free points; else contacts and the object's surface alone. balanced: weigh
    contacts by the number of free points per contact. ell: length scale of the kernel, metres.
    ell_min, ell_decay: after an ascent, ell is multiplied by ell_decay and the ascent goes on, as
    long as ell is above ell_min. sigma, s_sigma: amplitudes of the kernels of places and of equal
    labels; unequal labels have a kernel of 0. sp_thres: a product of the kernels that is not above
    it counts as 0; 0 keeps all of them. surface_band: nodes of the SDF this near to the surface
    make the object's surface, those farther outside its free space, metres; null: the SDF's
    resolution (r_t). c, d: what the rotational and the translational part of the flow are divided
    by, so that a turn by 1 rad counts as a shift by sqrt(c / d) m. origin: about which the flow
    turns, "world" as published, or the "workspace" centre. max_iterations: of an ascent. min_step,
    max_step: the least and the greatest length of a step that is tried first. stop_below: a start
    ends when its inner product grew by no more than this fraction in 5 iterations in a row; null:
    never.

    Preset paper: the authors' parameters, no threshold, and the paper's labels of the object's
    cloud. reference: their parameter file with its threshold, and the labels of their simulation
    (2 mm on real data); but without the cap of 512 neighbours in the order of their index, which
    drops 97 % of the kernel, and with the search for a step where they take a root that may lead
    downhill. default: the same model, made stronger: the flow turns about the workspace's centre,
    a turn by 1 rad counts as a shift by 0.1 m instead of 1 m, which is nearer to what it does to
    points of an object, and ell falls from 10 cm to 2.5 cm, as a smooth F is easy to climb and a
    sharp one tells where contacts are. Each of these ascents has the authors' iterations.
    """

    free_space: bool = True
    balanced: bool = False
    ell: float = 0.1
    ell_min: float = 0.025
    ell_decay: float = 0.5
    sigma: float = 0.1
    s_sigma: float = 0.8
    sp_thres: float = 0.0
    surface_band: float | None = None
    c: float = 0.07
    d: float = 7.0
    origin: str = "workspace"
    max_iterations: int = 100
    min_step: float = 1e-4
    max_step: float = 0.8
    stop_below: float | None = 1e-6
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
        for name in ("ell", "ell_min", "ell_decay", "sigma", "s_sigma", "c", "d"):
            require_positive(name, getattr(self, name))
        for name in ("max_iterations", "min_step", "max_step"):
            require_positive(name, getattr(self, name))
        for name in ("ell", "ell_min"):
            if not FINEST <= getattr(self, name) <= COARSEST:
                raise SettingError(
                    f"{name} is {getattr(self, name)}; accepted: {FINEST:g} to {COARSEST:g} (m)"
                )
        require_at_most("max_iterations", self.max_iterations, MOST_ITERATIONS)
        require_choice("origin", self.origin, ("world", "workspace"))
        if self.surface_band is not None:
            require_positive("surface_band", self.surface_band)
        require_positive("sp_thres", self.sp_thres, zero=True)
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
        if self.stop_below is not None:
            require_positive("stop_below", self.stop_below, zero=True)

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
    """The clouds of a problem at one length scale. norm: |f_x| |f_z|."""

    product: Product
    norm: float

    def values(self, poses: Poses) -> FloatArray:
        """F (B,) at poses."""
        out = np.empty(len(poses))

        def run(first: int, last: int, work: object) -> None:
            products(self.product, poses.numbers, out, first, last, work)

        spread(run, len(poses), scratch)
        return out

    def costs(self, values: FloatArray) -> FloatArray:
        """1 - F / (|f_x| |f_z|), in [0, 1] but for the field's interpolation."""
        return 1.0 - values / self.norm if self.norm > 0.0 else np.ones(len(values))


class Cvo:
    """Climbs the inner product of two clouds from every pose of E_0; E_l is not used.

    The observed cloud x: free points, and contacts; the object's z: nodes of the SDF grid within
    surface_band of the surface, and those farther outside. F(X) = sum_ij a(R x_i + t, z_j) over
    pairs of one class, with a = exp(-|x - z|^2 / (2 ell^2)), in units of sigma^2 s_sigma^2. Cost:
    1 - F / (|f_x| |f_z|), 1 minus the cosine between the clouds as functions, at the last ell; 1
    where they do not meet. Such a start stays where it is, as does all of E_0 if there is no point
    to use. Occupied points and points of a known distance that is not 0 are not used. A trace has
    the costs at the ell of its ascent.
    """

    def __init__(self, settings: CvoSettings | None = None) -> None:
        self.settings = settings or CvoSettings()

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

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
        poses, moved = _seen_from(centre, estimates), np.zeros(len(estimates), dtype=bool)
        done, total = 0, settings.max_iterations * len(settings.levels)
        for level, ell in enumerate(settings.levels):
            clouds = self._clouds(problem, ell, centre)
            states = np.zeros((len(poses), 5))
            states[:, VALUE] = clouds.values(poses)
            if level == 0:
                observer.trace("ascent", 0, estimates.vectors, clouds.costs(states[:, VALUE]))
            for count in self._blocks():
                self._climb(clouds.product, poses, states, count)
                moved |= states[:, MOVED] > 0.0
                done += count
                estimates = _placed(poses, moved, centre, initial)
                observer.trace("ascent", done, estimates.vectors, clouds.costs(states[:, VALUE]))
                observer.progress("ascent", done, total)
                if (states[:, DONE] > 0.0).all():
                    break
            done = (level + 1) * settings.max_iterations
        return ranked(estimates.matrices, clouds.costs(states[:, VALUE]))

    def _blocks(self) -> list[int]:
        """How many iterations each block has."""
        ends = [*range(0, self.settings.max_iterations, _BLOCK), self.settings.max_iterations]
        return [last - first for first, last in pairwise(ends)]

    def _climb(self, product: Product, poses: Poses, states: FloatArray, count: int) -> None:
        """Take poses some iterations uphill in place, each on its own."""
        settings = self.settings
        growth = log(settings.max_step / settings.min_step) / (STEPS - 1)
        steps = np.array([settings.min_step * exp(growth * k) for k in range(STEPS)])
        below = -1.0 if settings.stop_below is None else settings.stop_below
        ascent = Ascent(np.minimum(steps, settings.max_step), settings.c, settings.d, below)

        def run(first: int, last: int, work: object) -> None:
            climb(product, ascent, poses.numbers, states, count, first, last, work)

        spread(run, len(poses), scratch)

    def _clouds(self, problem: RegistrationProblem, ell: float, centre: FloatArray) -> _Clouds:
        """Both clouds; the observed one as seen from `centre` (3,)."""
        settings, sdf = self.settings, problem.sdf
        kernel = Kernel.above(ell, 1.0, settings.sp_thres / settings.amplitude)
        band = sdf.resolution if settings.surface_band is None else settings.surface_band
        contacts = problem.points.contacts
        free = problem.points.free if settings.free_space else np.zeros((0, 3))
        surface_z = surface_field(sdf, kernel, band)
        free_z = free_field(sdf, kernel, band) if settings.free_space else surface_z
        weight = len(free) / len(contacts) if settings.balanced and len(contacts) else 1.0
        weight = weight if len(free) else 1.0
        lattice = problem.free_resolution
        observed = weight * cloud_norm(contacts, kernel, lattice)
        of_object = weight * surface_z.norm
        if settings.free_space:
            observed += cloud_norm(free, kernel, lattice)
            of_object += free_z.norm
        alone, cubes, side = free, np.zeros((0, 3)), 1
        if settings.sp_thres == 0.0:
            alone, cubes, side = blocks_of(free, ell, lattice)
        block_z = free_z
        if side > 1:
            block_z = free_field(sdf, of_block(kernel, lattice, side), band)
        product = Product(
            free_z.term(alone - centre, 1.0),
            block_z.term(cubes - centre, 1.0),
            surface_z.term(contacts - centre, weight),
        )
        return _Clouds(product, float(np.sqrt(observed * of_object)))


def _seen_from(centre: FloatArray, poses: Poses) -> Poses:
    """The same poses in a world whose origin is at `centre` (3,)."""
    shifted = poses.translations + rotated(poses.rotations, centre)
    return Poses(np.concatenate([poses.numbers[:, :9], shifted], axis=1))


def _placed(poses: Poses, moved: np.ndarray, centre: FloatArray, initial: Poses) -> Poses:
    """Poses seen from `centre` (3,), back in the world; of E_0 those that never moved."""
    back = _seen_from(-centre, poses)
    return Poses(np.where(moved[:, None], back.numbers, initial.numbers))
