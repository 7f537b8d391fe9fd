"""The actions that a session with a free hand offers: straight probes on a lattice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from chsel.errors import SettingError
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import FloatArray, evenly_spaced
from chsel.problem.points import Workspace
from chsel.problem.poses import compose, rotated
from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive

FLOOR = 0.0  # height of the floor that the object lies on, metres
CLEARANCE = 0.005  # metres: no part of the hand comes nearer to the floor
MARGIN = 0.05  # metres: between the workspace and a hand that starts outside of it
_SHORTEST = 0.01  # metres: of an action worth offering
_WIDEST = 0.05  # metres: usual spacing
_PER_DIAMETER = 0.15  # spacing by the diameter of an object for which that is too wide
_USUAL = 200  # actions, at the widest spacing
_DENSEST = 5.0  # times as many at most
_COARSER = 1.02  # factor by which the spacing grows until there are few enough actions


@dataclass(frozen=True)
class ReachBall(CheckedSettings):
    """A ball of the world in which the hand's origin can be."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # metres
    radius: Annotated[float, positive] = 0.8  # metres


@dataclass(frozen=True)
class ActionSettings(CheckedSettings):
    """The probes that a session offers. A recorded session offers its probes."""

    # "configuration" the grid of the session itself, "forward" along its approach direction on a
    # lattice across the workspace, "around" from the sides and from above.
    choice: Annotated[str, one_of("configuration", "forward", "around")] = "around"
    # Of the lattice, metres; it is coarser where more than `most` actions would result. None: 15 %
    # of the object's diameter, at most 0.05.
    spacing: Annotated[float | None, positive] = None
    # Actions; None: as many as cover the area that 200 cover 0.05 apart, at most 1000.
    most: Annotated[int | None, positive, at_most(10_000)] = None
    # Where the hand can be; actions that begin outside of it are left out, and those that lead out
    # of it end there. None: everywhere.
    reach: ReachBall | None = None
    # Metres a second of the hand, with which the way to the end of a probe and back takes time;
    # None: all actions count as equally long.
    speed: Annotated[float | None, positive] = None
    setup: Annotated[float, not_negative] = 1.0  # seconds that every probe takes besides

    def for_object(self, diameter: float | None) -> ActionSettings:
        """Return these settings with numbers for `spacing` and `most`.

        diameter: of the object, metres; None if it is not known, and the spacing is the widest.
        """
        spacing = self.spacing
        if spacing is None:
            spacing = _WIDEST if diameter is None else min(_WIDEST, _PER_DIAMETER * diameter)
        most = self.most
        if most is None:
            most = round(_USUAL * min(max(_WIDEST / spacing, 1.0) ** 2, _DENSEST))
        return replace(self, spacing=spacing, most=most)


def straight_actions(settings: ActionSettings, poses: FloatArray, *, length: FloatArray) -> Actions:
    """Return actions from poses (A, 4, 4) along z for lengths (A,), as far as reach allows.

    Those of length 0 are left out. Seconds, if a speed is given: there and back, and the setup.
    Raises SettingError if none is left.
    """
    kept = length > 0.0
    if settings.reach is not None:
        within = _way_within(settings.reach, poses)
        kept &= within >= np.minimum(length, _SHORTEST)
        length = np.minimum(length, within)
    if not kept.any():
        raise SettingError(
            "policy.actions leaves no action; accepted: a workspace above the floor, and a reach "
            "that holds the start of at least one"
        )
    poses, length = poses[kept], length[kept]
    if settings.speed is None:
        return Actions(poses, length)
    return Actions(poses, length, seconds=settings.setup + 2.0 * length / settings.speed)


def forward_actions(
    settings: ActionSettings,
    workspace: Workspace,
    *,
    hand: HandShape,
    rotation: FloatArray,
    start: float,
    length: float,
    diameter: float | None = None,
) -> Actions:
    """Return a lattice across a workspace, all in one horizontal direction.

    rotation (3, 3): world_from_hand. start: of the hand's origin along that direction, metres in
    the world. length: of every action, metres. diameter: see `ActionSettings.for_object`. Raises
    SettingError if none is left.
    """
    settings = settings.for_object(diameter)

    def lattice(spacing: float) -> _Lattice:
        approach = _Approach(workspace, hand, rotation=rotation)
        places = approach.places(spacing)
        return approach.poses(places, start), np.full(len(places), length)

    starts, lengths = _few_enough(settings, workspace, lattice=lattice)
    return straight_actions(settings, starts, length=lengths)


def around_actions(
    settings: ActionSettings,
    workspace: Workspace,
    *,
    hand: HandShape,
    diameter: float | None = None,
) -> Actions:
    """Return lattices of actions that cross a workspace from outside, as far as the floor.

    From the four sides, and from above. Opposite sides are half a spacing apart, as what one of
    them misses the other should meet. diameter: see `ActionSettings.for_object`. Raises
    SettingError if none is left.
    """
    settings = settings.for_object(diameter)

    def lattice(spacing: float) -> _Lattice:
        parts = []
        for rotation, shift in _AROUND:
            approach = _Approach(workspace, hand, rotation=rotation)
            places = approach.places(spacing, shift)
            start = approach.nearest - MARGIN - float(hand.bounds[1, 2])
            poses = approach.poses(places, start)
            length = approach.lengths(places, start)
            parts.append((poses[length > 0.0], length[length > 0.0]))
        return np.concatenate([part[0] for part in parts]), np.concatenate([p[1] for p in parts])

    starts, lengths = _few_enough(settings, workspace, lattice=lattice)
    return straight_actions(settings, starts, length=lengths)


def _rotation(across: tuple[float, ...], forward: tuple[float, ...]) -> FloatArray:
    """Return world_from_hand (3, 3) of a hand that is wide `across` and probes `forward`."""
    y, z = np.array(across), np.array(forward)
    return np.stack([np.cross(y, z), y, z], axis=1)


# Orientations of the hand, and by how many spacings its lattice is shifted along its wide side,
# which is horizontal.
_AROUND = (
    (_rotation((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), -0.25),
    (_rotation((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)), -0.25),
    (_rotation((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), -0.25),
    (_rotation((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)), -0.25),
    (_rotation((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)), 0.0),
)


# Starts (A, 4, 4), and how far the hand goes (A,), metres.
_Lattice = tuple[FloatArray, FloatArray]


class _Approach:
    """A workspace above the floor, seen by a hand of one orientation that moves along its z axis.

    A place is where the hand's way meets the plane through the world's origin that it stands on,
    as coordinates (2,) along the hand's wide side, and along the axis to both, which points up.
    """

    def __init__(self, workspace: Workspace, hand: HandShape, *, rotation: FloatArray) -> None:
        lower, upper = workspace.bounds
        lower[2] = max(lower[2], FLOOR)
        upper[2] = max(upper[2], lower[2])  # of a workspace below the floor nothing is left
        self._box = np.array([lower, upper])
        self._rotation = rotation
        self._axes = np.stack([rotation[:, 1], -rotation[:, 0]])  # (2, 3)
        self._direction = rotation[:, 2]
        choices = np.array(list(np.ndindex(2, 2, 2)))
        corners = self._box[choices, np.arange(3)]  # (8, 3)
        self._spans = rotated(self._axes, corners)  # (8, 2)
        self.nearest = float(rotated(self._direction[None], corners).min())
        self._lowest = float(rotated(rotation[2:], hand.vertices).min())  # of the hand, from its z
        self._front = float(hand.bounds[1, 2])

    def places(self, spacing: float, shift: float = 0.0) -> FloatArray:
        """Return a lattice (A, 2) of places across the workspace; shift: of the first, in spacings.

        If the hand moves horizontally, the lowest row is just above the floor.
        """
        low, high = self._spans.min(axis=0), self._spans.max(axis=0)
        first = _centred(low[0], high[0], spacing=spacing) + shift * spacing
        if self._direction[2] == 0.0:
            bottom = max(low[1], FLOOR + CLEARANCE - self._lowest)
            count = int((high[1] - bottom) / spacing) + 1 if high[1] >= bottom else 0
            second = bottom + spacing * np.arange(count)
        else:
            second = _centred(low[1], high[1], spacing=spacing)
        return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)

    def poses(self, places: FloatArray, start: float) -> FloatArray:
        """Return poses (A, 4, 4) at places (A, 2), `start` metres along the probes."""
        positions = places[:, :1] * self._axes[0] + places[:, 1:] * self._axes[1]
        positions = positions + start * self._direction
        return compose(np.broadcast_to(self._rotation, (len(places), 3, 3)), positions)

    def lengths(self, places: FloatArray, start: float) -> FloatArray:
        """Return lengths (A,) from `start` until the hand's front is through the workspace.

        It stops above the floor. 0 where it does not get into the workspace.
        """
        positions = self.poses(places, start)[:, :3, 3]
        moving = self._direction != 0.0
        with np.errstate(all="ignore"):
            ends = np.sort((self._box - positions[:, None]) / self._direction, axis=1)
        enter = np.where(moving, ends[:, 0], -np.inf).max(axis=1)
        leave = np.where(moving, ends[:, 1], np.inf).min(axis=1)
        beside = (positions < self._box[0]) | (positions > self._box[1])
        length = leave - self._front
        height = positions[:, 2] + self._lowest - FLOOR - CLEARANCE
        if self._direction[2] < 0.0:
            length = np.minimum(length, height / -self._direction[2])
        else:
            length = np.where(height > -1e-9, length, 0.0)
        useful = (length - (enter - self._front) > _SHORTEST) & ~(beside & ~moving).any(axis=1)
        return np.where(useful, length, 0.0)


def _centred(low: float, high: float, *, spacing: float) -> FloatArray:
    """Return the middles (N,) of intervals of a spacing that cover what is between two numbers."""
    count = max(int(np.ceil((high - low) / spacing - 0.5)), 1)
    steps: FloatArray = np.arange(count, dtype=np.float64) - 0.5 * (count - 1)
    return 0.5 * (low + high) + spacing * steps


def _few_enough(
    settings: ActionSettings, workspace: Workspace, *, lattice: Callable[[float], _Lattice]
) -> _Lattice:
    """Return the lattice at the spacing of the settings, or the next coarser one allowed."""
    assert settings.spacing is not None
    assert settings.most is not None
    sides = np.sort(np.ptp(workspace.bounds, axis=0))
    # With any less, one face alone has more.
    face = float(np.sqrt(sides[1] * sides[2] / (2.0 * settings.most)))
    spacing = max(settings.spacing, float(sides[2]) / settings.most, face)
    poses, length = lattice(spacing)
    while len(length) > settings.most and spacing < 2.0 * sides[2]:
        spacing *= _COARSER
        poses, length = lattice(spacing)
    chosen = evenly_spaced(len(length), settings.most)
    return poses[chosen], length[chosen]


def _way_within(reach: ReachBall, poses: FloatArray) -> FloatArray:
    """Return lengths (A,) that a hand can go from poses (A, 4, 4) along z; -1 from outside."""
    offset = poses[:, :3, 3] - np.array(reach.center)
    direction = poses[:, :3, 2]
    along = (offset * direction).sum(axis=1)
    inside = reach.radius * reach.radius - (offset * offset).sum(axis=1)
    way = np.sqrt(np.maximum(along * along + inside, 0.0)) - along
    return np.where(inside >= 0.0, way, -1.0)
