"""Definition of the plausible set: its cost, and the grid of poses that is scanned."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from chsel.errors import SettingError, require_at_most, require_choice
from chsel.numerics.arrays import FloatArray
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.settings import (
    CheckedSettings,
    at_most,
    not_negative,
    one_of,
    positive,
    settings_mapping,
)

DEFINITIONS = ("default", "paper", "reference", "wide_means", "wide_means_10mm", "wide_sums")
MOST_POSITIONS = 100_000
MOST_ROTATIONS = 1_000_000
MOST_STARTS = 20_000
Axis = tuple[tuple[float, float, int], ...]


@dataclass(frozen=True)
class EvaluationCostSettings(CheckedSettings):
    """Settings of the cost C that only evaluation uses (CHSEL, Eq. 2)."""

    # "sums" over points (the paper), "means" over each class (its code).
    combine: Annotated[str, one_of("means", "sums")] = "means"
    violation: Annotated[float, positive] = 1e5  # c_max, of a point on the wrong side
    # Metres that a point may be on the wrong side; 0 in the paper.
    tolerance: Annotated[float, not_negative] = 0.01
    occupied: bool = True  # whether occupied points count
    lookup: Annotated[str, one_of(*LOOKUPS)] = "nearest"  # how the SDF is read, see SdfGrid.at
    outside: Annotated[str, one_of(*OUTSIDE)] = "surface_point"  # and beyond its box


@dataclass(frozen=True)
class Offsets:
    """Offsets in the world, metres: along x, y, z pieces (first, last, count) of even spacing."""

    x: Axis = ((-0.1, 0.15, 15),)  # pieces along x
    y: Axis = ((-0.2, 0.2, 15),)  # pieces along y
    z: Axis = ((0.0, 0.1, 15),)  # pieces along z

    def __post_init__(self) -> None:
        counts = [sum(piece[2] for piece in axis) for axis in self.axes]
        if min(counts) < 1:
            raise SettingError(
                f"offsets are {counts} along x, y and z; accepted: at least one along each"
            )
        require_at_most("the number of offsets", math.prod(counts), most=MOST_POSITIONS)

    @property
    def axes(self) -> tuple[Axis, Axis, Axis]:
        """Pieces along x, y and z."""
        return self.x, self.y, self.z

    def points(self) -> FloatArray:
        """Return the offsets (P, 3), those along z fastest."""
        axes = [
            np.concatenate([np.linspace(first, last, count) for first, last, count in axis])
            for axis in self.axes
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class PoseGridSettings(CheckedSettings):
    """The poses that are scanned: positions around the true one, each with every rotation."""

    offsets: Offsets = field(default_factory=Offsets)  # of the positions
    rotations: Annotated[int, positive, at_most(MOST_ROTATIONS)] = 10_000  # uniform on SO(3)
    # Yaws of the object's frame on the world's, evenly spaced.
    upright: Annotated[int, not_negative, at_most(MOST_ROTATIONS)] = 100
    # The upright and the true rotation: "added", "replaced" (in place of the first), or "none".
    extra: Annotated[str, one_of("added", "replaced", "none")] = "added"
    seed: int | None = None  # of the rotations; by default that of the session


@dataclass(frozen=True)
class ModeSearchSettings(CheckedSettings):
    """Search for members in modes between the poses of the grid.

    Poses of the grid climb if their mean over known points is less than `distance` above the true
    pose's, and few points are deeper than `depth` on the wrong side.
    """

    starts: Annotated[int, positive, at_most(MOST_STARTS)] = 1000  # poses that climb, at most
    distance: Annotated[float, positive] = 0.01  # metres
    depth: Annotated[float, positive] = 0.02  # metres
    # Root mean square, of a new mode's surface from all other members', metres.
    separation: Annotated[float, positive] = 0.01


@dataclass(frozen=True)
class PlausibleSettings(CheckedSettings):
    """The plausible set P_eps = {X : C(X) < C(X*) + eps} (CHSEL, Sec. III and V)."""

    epsilon: Annotated[float, positive] = 0.001  # eps, metres
    cost: EvaluationCostSettings = field(default_factory=EvaluationCostSettings)  # C
    grid: PoseGridSettings = field(default_factory=PoseGridSettings)  # of poses X
    members: Annotated[int, positive] = 1000  # kept for evaluation at most, a random subset
    # With fewer members on the grid, others are sought around them; 0: never.
    fill_to: Annotated[int, not_negative] = 30
    modes: ModeSearchSettings | None = None  # how to look for members far from all on the grid

    @property
    def text(self) -> str:
        """The settings as JSON."""
        return json.dumps(settings_mapping(self), sort_keys=True)

    @property
    def digest(self) -> str:
        """Digest of all settings."""
        return hashlib.blake2b(self.text.encode(), digest_size=16).hexdigest()


def plausible_settings(definition: str, epsilon: float) -> PlausibleSettings:
    """Return the settings of a definition, eps in metres.

    "paper": sums, no tolerance, 10 000 uniform rotations. "reference": as in the authors'
    simulated experiments, with c_max 1000, a longer x axis and the same rotations for all seeds.
    "default": the reference's means and tolerance on the paper's grid, with c_max 1e5, occupied
    points counted, and the upright and the true rotation added.

    "wide_means", "wide_sums": 300 members or more of a set that no box cuts off, from a wider grid
    and a search for modes that it misses; distances are interpolated, as nearest nodes, 10 mm
    apart, move the true pose itself by 1 to 4 mm. By means over points as the authors' code, or
    by sums as the paper's Eq. 2; no free point may be inside of a member. "wide_means_10mm":
    free points may be 10 mm deep inside of a member, as in the authors' code.
    """
    require_choice("definition", definition, accepted=DEFINITIONS)
    default = PlausibleSettings(epsilon=epsilon)
    if definition == "paper":
        cost = EvaluationCostSettings("sums", tolerance=0.0, lookup="nearest")
        return replace(default, cost=cost, grid=PoseGridSettings(upright=0, extra="none"))
    if definition == "reference":
        cost = EvaluationCostSettings(
            violation=1e3, occupied=False, lookup="nearest", outside="bounding_box"
        )
        cell = 0.2 / 15
        offsets = Offsets(x=((-0.1, 0.0, 5), (cell, 0.3, 10)), y=((-0.2, 0.0, 7), (cell, 0.2, 7)))
        grid = PoseGridSettings(offsets, extra="replaced", seed=0)
        return replace(default, cost=cost, grid=grid, fill_to=0)
    if definition.startswith("wide"):
        combine = "sums" if definition == "wide_sums" else "means"
        tolerance = 0.01 if definition == "wide_means_10mm" else 0.0
        cost = EvaluationCostSettings(combine, tolerance=tolerance, lookup="trilinear")
        sides = ((-0.5, 0.5, 36),)
        grid = PoseGridSettings(Offsets(sides, sides, z=((-0.3, 0.5, 29),)))
        modes = ModeSearchSettings(starts=8000)
        return replace(default, cost=cost, grid=grid, fill_to=300, modes=modes)
    return default


def definition_name(settings: PlausibleSettings) -> str | None:
    """Return the name of the definition of these settings, whatever its epsilon; else None."""
    named = ((name, plausible_settings(name, settings.epsilon)) for name in DEFINITIONS)
    return next((name for name, by in named if by == settings), None)
