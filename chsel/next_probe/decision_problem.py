"""One decision: the problem that determines it, with the hand that probes, and its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chsel.errors import PoseError, SettingError, require_choice, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, digest, frozen
from chsel.numerics.compiler import compiled
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import check_rigid
from chsel.problem.registration_problem import VERDICTS
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.streams import StreamKey

if TYPE_CHECKING:
    import trimesh


CELL = 0.002  # metres: side of the cells of the front
_LARGEST = 2.0  # metres from its origin that a hand reaches
STOPS = ("", "spread", "gain", "actions", "budget")
"""Why no further probe is made: the set is small, no action promises to make it smaller, there is
none left that can be taken, or as many were made as were allowed. "" if one is made."""


class HandFront(NamedTuple):
    """The reach of the hand along its z axis, over cells of its x and y axes."""

    heights: FloatArray  # (X, Y), metres; -inf where there is no hand
    lower: FloatArray  # (2,): x and y of the first cell's corner, hand frame, metres
    cell: float  # side of a cell, metres


class HandShape:
    """The surface of a hand in its own frame, metres; it probes along its z axis.

    vertices (V, 3), faces (F, 3): triangles of one or more closed bodies.
    Raises SettingError for a hand without a face, or one that reaches more than 2 m.
    """

    def __init__(self, vertices: Any, faces: Any) -> None:
        self.vertices: FloatArray = frozen(
            "hand vertices", vertices, shape=(None, 3), error=SettingError
        )
        self.faces: IntArray = frozen(
            "hand faces", faces, shape=(None, 3), dtype=np.int64, error=SettingError
        )
        if len(self.faces) == 0 or self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise SettingError("the hand has no faces between its vertices; accepted: a mesh")
        farthest = float(np.abs(self.vertices).max())
        if farthest > _LARGEST:
            raise SettingError(
                f"the hand reaches {farthest:.3g} m from its origin; accepted: up to {_LARGEST:g} m"
            )

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> HandShape:
        """Return the shape of a mesh in the hand's frame, metres."""
        return cls(mesh.vertices, mesh.faces)

    @cached_property
    def digest(self) -> str:
        """Digest of vertices and faces."""
        return digest(self.vertices, self.faces)

    @cached_property
    def front(self) -> HandFront:
        """The hand as seen from what it moves towards."""
        vertices = np.array(self.vertices)
        lower = vertices[:, :2].min(axis=0) - CELL
        counts = np.ceil((vertices[:, :2].max(axis=0) + CELL - lower) / CELL).astype(np.int64)
        heights = np.full(tuple(counts), -np.inf)
        front = HandFront(heights, lower, cell=CELL)
        raise_front(front, vertices, np.array(self.faces))
        heights.setflags(write=False)
        return front

    @property
    def bounds(self) -> FloatArray:
        """Lower and upper corner (2, 3) in the hand's frame."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])


@compiled
def raise_front(front: Any, vertices: Any, faces: Any) -> None:
    """Raise the cells of a HandFront to the highest of the faces (F, 3) over their centres.

    Cells that hold a vertex are at least as high as it, however thin the faces around it are.
    """
    heights, cell = front.heights, front.cell
    x0, y0 = front.lower[0], front.lower[1]
    for v in range(len(vertices)):
        i, j = int((vertices[v, 0] - x0) / cell), int((vertices[v, 1] - y0) / cell)
        heights[i, j] = max(heights[i, j], vertices[v, 2])
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        double_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if double_area == 0.0:
            continue
        first_i = int((min(a[0], b[0], c[0]) - x0) / cell)
        last_i = int((max(a[0], b[0], c[0]) - x0) / cell)
        first_j = int((min(a[1], b[1], c[1]) - y0) / cell)
        last_j = int((max(a[1], b[1], c[1]) - y0) / cell)
        for i in range(first_i, last_i + 1):
            x = x0 + (i + 0.5) * cell
            for j in range(first_j, last_j + 1):
                y = y0 + (j + 0.5) * cell
                p = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / double_area
                q = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / double_area
                r = 1.0 - p - q
                if p >= 0.0 and q >= 0.0 and r >= 0.0:
                    heights[i, j] = max(heights[i, j], p * a[2] + q * b[2] + r * c[2])


@dataclass(frozen=True, eq=False)
class Actions:
    """A straight probes: the hand starts at a pose and moves along its own z axis."""

    world_from_hand: FloatArray  # (A, 4, 4): where the hand starts
    length: FloatArray  # (A,): how far it goes unless it meets something, metres
    # (A,): how long a probe takes with the way to its start and back; None if it does not matter.
    seconds: FloatArray | None = None

    def __post_init__(self) -> None:
        poses = _near_poses("actions", self.world_from_hand)
        object.__setattr__(self, "world_from_hand", poses)
        for name in ("length", "seconds"):
            value = getattr(self, name)
            if value is not None:
                value = frozen(f"{name} of actions", value, shape=(len(poses),), error=SettingError)
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
class WeightedPoses:
    """K poses that the object may have, and how probable each is."""

    object_from_world: FloatArray  # (K, 4, 4)
    weights: FloatArray  # (K,), not negative, of sum 1 but for rounding

    def __post_init__(self) -> None:
        poses = _near_poses("belief", self.object_from_world)
        if len(poses) == 0:
            raise PoseError("the belief has no poses; accepted: at least one")
        weights = frozen("weights", self.weights, shape=(len(poses),), error=SettingError)
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


@dataclass(frozen=True, eq=False, kw_only=True)
class DecisionProblem:
    """Everything that determines one decision, and nothing else but a policy's settings."""

    sdf: SdfGrid  # of the object, in its frame
    points: KnownPoints  # all that are known, in the world
    workspace: Workspace  # where the object can be
    free_resolution: float  # side of the voxels of free space, metres
    belief: WeightedPoses  # weighted poses of the object
    actions: Actions  # that the session offers
    available: BoolArray  # (A,): which of them can be taken now
    hand: HandShape  # that probes
    key: StreamKey  # of the random streams; its step is the number of probes done
    verdict: str = ""  # on the result that the belief is of, one of VERDICTS; "" if there is none

    def __post_init__(self) -> None:
        require_positive("free_resolution", self.free_resolution)
        require_choice("verdict", self.verdict, accepted=("", *VERDICTS))
        flags = frozen(
            "available",
            self.available,
            shape=(len(self.actions),),
            dtype=np.bool_,
            error=SettingError,
        )
        object.__setattr__(self, "available", flags)

    @cached_property
    def digest(self) -> str:
        """Digest of the problem."""
        parts = (self.sdf, self.points, self.belief, self.actions, self.hand)
        text = np.frombuffer("".join(part.digest for part in parts).encode(), dtype=np.uint8)
        numbers = np.array([*self.workspace.lower, *self.workspace.upper, self.free_resolution])
        key = np.array([self.key.seed, self.key.step], dtype=np.uint64)
        verdict = [np.array([float(VERDICTS.index(self.verdict))])] if self.verdict else []
        return digest(text, numbers, self.available, key, *verdict)


@dataclass(frozen=True, eq=False, kw_only=True)
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
        require_choice("stop", self.stop, accepted=STOPS)

    @cached_property
    def digest(self) -> str:
        """Digest of all of it."""
        numbers = np.array([float(self.chosen), float(STOPS.index(self.stop)), self.spread])
        return digest(
            numbers,
            self.score,
            self.hit_chance,
            self.blocked_chance,
            self.expected_spread,
            self.contacts,
        )


def _near_poses(name: str, transforms: FloatArray) -> FloatArray:
    """Return rigid transforms (B, 4, 4); PoseError for others, or farther than FARTHEST."""
    poses = frozen(name, transforms, shape=(None, 4, 4), error=PoseError)
    check_rigid(name, poses)
    far = np.abs(poses[:, :3, 3]).max(axis=1, initial=0.0) > FARTHEST
    if far.any():
        raise PoseError(
            f"{name}[{int(np.argmax(far))}] is beyond {FARTHEST:g} m; accepted: places within"
        )
    return poses
