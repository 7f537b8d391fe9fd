"""One decision: the problem that determines it, and its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from chsel.errors import PoseError, SettingError, require_choice, require_positive
from chsel.next_probe.hand_shape import HandShape
from chsel.numerics.arrays import BoolArray, FloatArray, digest, frozen
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import check_rigid
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.streams import StreamKey

MOST_ACTIONS = 20_000  # that are compared in one decision


@dataclass(frozen=True, eq=False)
class Actions:
    """A straight probes: the hand starts at a pose and moves along its own z axis."""

    world_from_hand: FloatArray  # (A, 4, 4): where the hand starts
    length: FloatArray  # (A,): how far it goes unless it meets something, metres
    # (A,): how long a probe takes with the way to its start and back; None if it does not matter.
    seconds: FloatArray | None = None

    def __post_init__(self) -> None:
        poses = frozen("actions", self.world_from_hand, (None, 4, 4), error=PoseError)
        check_rigid("actions", poses)
        _check_near("actions", poses)
        if len(poses) > MOST_ACTIONS:
            raise SettingError(f"there are {len(poses)} actions; accepted: at most {MOST_ACTIONS}")
        object.__setattr__(self, "world_from_hand", poses)
        for name in ("length", "seconds"):
            value = getattr(self, name)
            if value is not None:
                value = frozen(f"{name} of actions", value, (len(poses),), error=SettingError)
                if not (value > 0.0).all():
                    raise SettingError(f"{name} of actions has {value.min()}; accepted: above 0")
                object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.length)

    @cached_property
    def digest(self) -> str:
        """Digest of all arrays."""
        seconds = np.zeros(0) if self.seconds is None else self.seconds
        return digest(self.world_from_hand, self.length, seconds)


@dataclass(frozen=True, eq=False)
class Belief:
    """K poses that the object may have, and how probable each is."""

    object_from_world: FloatArray  # (K, 4, 4)
    weights: FloatArray  # (K,), not negative, of sum 1 but for rounding

    def __post_init__(self) -> None:
        poses = frozen("belief", self.object_from_world, (None, 4, 4), error=PoseError)
        check_rigid("belief", poses)
        _check_near("belief", poses)
        if len(poses) == 0:
            raise PoseError("the belief has no poses; accepted: at least one")
        weights = frozen("weights", self.weights, (len(poses),), error=SettingError)
        if weights.min() < 0.0 or abs(float(weights.sum()) - 1.0) > 1e-6:
            raise SettingError("weights are not a distribution; accepted: none negative, of sum 1")
        object.__setattr__(self, "object_from_world", poses)
        object.__setattr__(self, "weights", weights)

    def __len__(self) -> int:
        return len(self.weights)

    @cached_property
    def digest(self) -> str:
        """Digest of poses and weights."""
        return digest(self.object_from_world, self.weights)


@dataclass(frozen=True, eq=False)
class DecisionProblem:
    """Everything that determines one decision, and nothing else but a policy's settings."""

    sdf: SdfGrid  # of the object, in its frame
    points: KnownPoints  # all that are known, in the world
    workspace: Workspace  # where the object can be
    free_resolution: float  # side of the voxels of free space, metres
    belief: Belief
    actions: Actions  # that the session offers
    available: BoolArray  # (A,): which of them can be taken now
    hand: HandShape
    key: StreamKey  # of the random streams; its step is the number of probes done

    def __post_init__(self) -> None:
        require_positive("free_resolution", self.free_resolution)
        farthest = float(np.abs(self.hand.bounds).max())
        if farthest > FARTHEST:
            raise SettingError(
                f"the hand reaches {farthest:.3g} m from its origin; accepted: up to {FARTHEST:g} m"
            )
        flags = frozen(
            "available", self.available, (len(self.actions),), dtype=np.bool_, error=SettingError
        )
        object.__setattr__(self, "available", flags)

    @cached_property
    def digest(self) -> str:
        """Digest of the problem."""
        parts = (self.sdf, self.points, self.belief, self.actions, self.hand)
        text = np.frombuffer("".join(part.digest for part in parts).encode(), dtype=np.uint8)
        numbers = np.array([*self.workspace.lower, *self.workspace.upper, self.free_resolution])
        key = np.array([self.key.seed, self.key.step], dtype=np.uint64)
        return digest(text, numbers, self.available, key)


STOPS = ("", "spread", "gain", "actions", "budget")
"""Why no further probe is made: the set is small, no action promises to make it smaller, there is
none left that can be taken, or as many were made as were allowed. "" if one is made."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The result of one decision. Scores and forecasts are those of all A actions.

    An action that cannot be taken has the score -inf.
    """

    chosen: int  # index of the action to take; -1 for none
    stop: str  # why none is taken, one of STOPS
    spread: float  # of the belief: root mean square distance of two surfaces, metres
    score: FloatArray  # (A,): the higher the better, in the policy's own unit
    hit_chance: FloatArray  # (A,): that the hand meets the object
    blocked_chance: FloatArray  # (A,): that the object is in the way to the start
    expected_spread: FloatArray  # (A,): of the belief after the action, metres
    # Of the chosen action: where the hand meets the object in the poses of the belief (K, 3), world
    # frame; NaN where it does not.
    contacts: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        require_choice("stop", self.stop, STOPS)

    @cached_property
    def digest(self) -> str:
        """Digest of all of it."""
        arrays = self.score, self.hit_chance, self.blocked_chance, self.expected_spread
        numbers = np.array([float(self.chosen), float(STOPS.index(self.stop)), self.spread])
        return digest(numbers, *arrays, self.contacts)


def _check_near(name: str, transforms: FloatArray) -> None:
    """Raise PoseError unless transforms (B, 4, 4) move by at most FARTHEST along each axis."""
    far = np.abs(transforms[:, :3, 3]).max(axis=1) > FARTHEST
    if far.any():
        raise PoseError(
            f"{name}[{int(np.argmax(far))}] is beyond {FARTHEST:g} m; accepted: places within"
        )
