"""Where frames and joints of a robot were over time, from the messages of a log."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.problem.poses import compose, inverse, rotation_matrices, slerp
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import Received, TransformMessage

_NANOSECONDS = 1e9
_MOST_LISTED = 30
_NUMBERS = 7  # of a pose: position, quaternion
_SAME = 1e-6  # metres, and parts of a quaternion

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_OF_A_PROBE = 50

Joints = dict[str, float]


class TransformError(SessionError):
    """A pose cannot be had from the transforms of a log."""


class TransformTree:
    """Poses of frames in one another at any time.

    faults: transforms that contradict others, with how often; the ones that came first count.
    times (T,): of all transforms that move, nanoseconds, ascending.
    """

    def __init__(self) -> None:
        self.faults: Counter[str] = Counter()
        self.times: IntArray = np.zeros(0, dtype=np.int64)
        self._edges: dict[str, _Edge] = {}  # by child

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(self, received: Received, message: TransformMessage) -> None:
        """Take note of a transform, in any order; it counts once the clocks are settled."""
        parent, child = message.parent, message.child
        edge = self._edges.get(child)
        if edge is None:
            if child in self._ancestry(parent):
                self.faults[f"frame {child} is its own ancestor, by way of {parent}"] += 1
                return
            edge = self._edges[child] = _Edge(parent)
        elif edge.parent != parent:
            self.faults[f"frame {child} has two parents, {edge.parent} and {parent}"] += 1
            return
        if not edge.add(received, message):
            self.faults[f"frame {child} is static in several places"] += 1

    def settle(self, clocks: ClockCorrection) -> None:
        """All transforms were added; their times are those by the clocks."""
        for edge in self._edges.values():
            edge.settle(clocks)
        nothing = np.zeros(0, dtype=np.int64)
        times = [edge.times for edge in self._edges.values()]
        self.times = np.unique(np.concatenate([nothing, *times]))

    def lookup(self, target: str, source: str, stamp_ns: int, *, gap_s: float) -> FloatArray:
        """target_from_source (4, 4) at a time, nanoseconds.

        Linear in position and along the shorter arc of rotation between samples at most `gap_s`
        seconds apart; before the first and after the last sample, by at most `gap_s`, as they are.
        Raises TransformError if a frame is unknown, not connected, or not known at that time.
        """
        poses, valid = self.lookups(target, source, np.array([stamp_ns]), gap_s=gap_s)
        if not valid[0]:
            raise TransformError(self._missing(target, source, stamp_ns, gap_s))
        pose: FloatArray = poses[0]
        return pose

    def lookups(
        self, target: str, source: str, stamps_ns: IntArray, *, gap_s: float
    ) -> tuple[FloatArray, BoolArray]:
        """target_from_source (N, 4, 4) at times (N,), and whether (N,) it is known; NaN if not.

        Raises TransformError if a frame is unknown or not connected to the other.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64).reshape(-1)
        down, up = self._path(target, source)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        valid = np.ones(len(stamps), dtype=bool)
        # root_from_source, each transform to the left of those below it; then root_from_target
        for chain, flip in ((up, False), (down, True)):
            root = np.tile(np.eye(4), (len(stamps), 1, 1))
            for child in chain:
                parent_from_child, known = self._edges[child].at(stamps, gap_s)
                root, valid = parent_from_child @ root, valid & known
            poses = inverse(root) @ poses if flip else root @ poses
        poses[~valid] = np.nan
        return poses, valid

    def _ancestry(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root of its tree."""
        found = [frame]
        while (edge := self._edges.get(found[-1])) is not None:
            found.append(edge.parent)
        return found

    def _path(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Children of the transforms up from each of the frames to where their ways meet."""
        frames = self.frames
        for name in (target, source):
            if name not in frames and target != source:
                raise TransformError(
                    f"frame {name} is in no transform; there are {_listed(frames)}"
                )
        from_target, from_source = self._ancestry(target), self._ancestry(source)
        if from_target[-1] != from_source[-1]:
            trees = "; ".join(
                f"{root}: {_listed([name for name in frames if self._ancestry(name)[-1] == root])}"
                for root in dict.fromkeys((from_target[-1], from_source[-1]))
            )
            raise TransformError(
                f"frames {target} and {source} are not connected, but in two trees: {trees}"
            )
        shared = set(from_target) & set(from_source)
        return (
            [name for name in from_target if name not in shared],
            [name for name in from_source if name not in shared],
        )

    def _missing(self, target: str, source: str, stamp_ns: int, gap_s: float) -> str:
        """Which transform is not known at a time, and when it is."""
        stamps = np.array([stamp_ns])
        for child in [name for path in self._path(target, source) for name in path]:
            edge = self._edges[child]
            if not edge.at(stamps, gap_s)[1][0]:
                away = edge.nearest(stamp_ns)
                side = "before" if away < 0 else "after"
                return (
                    f"{target} from {source}: {child} in {edge.parent} is not known at "
                    f"{stamp_ns / _NANOSECONDS:.3f} s; the nearest is {abs(away):.3f} s {side}, "
                    f"and gaps of up to {gap_s:g} s are bridged"
                )
        return f"{target} from {source} is not known at {stamp_ns / _NANOSECONDS:.3f} s"


class _Edge:
    """Poses of one frame in its parent's over time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.times: IntArray = np.zeros(0, dtype=np.int64)  # (N,), rising
        self._numbers: FloatArray = np.zeros((0, _NUMBERS))
        self._static: tuple[int, FloatArray] | None = None
        self._added: dict[str, tuple[array[int], array[int], array[float]]] = {}
        """The log's times, stamps and poses by topic."""

    def add(self, received: Received, message: TransformMessage) -> bool:
        """Whether the pose agrees with earlier ones; of static ones the latest holds."""
        rows = message.parent_from_child.tolist()
        numbers = (rows[0][3], rows[1][3], rows[2][3], *unit_quaternion(rows))
        if message.static:
            pose, stamp = np.array(numbers), received.stamp or received.log_time
            before, self._static = self._static, self._static or (stamp, pose)
            if stamp >= self._static[0]:
                self._static = (stamp, pose)
            return before is None or _agree(before[1], pose)
        added = self._added.setdefault(received.topic, (array("q"), array("q"), array("d")))
        added[0].append(received.log_time)
        added[1].append(received.stamp or 0)
        added[2].extend(numbers)
        return True

    def settle(self, clocks: ClockCorrection) -> None:
        """Sort the poses by time; of equal times the first that came counts."""
        if not self._added:
            return
        times = [clocks.times(topic, *some[:2]) for topic, some in self._added.items()]
        numbers = np.concatenate([np.frombuffer(some[2]) for some in self._added.values()])
        self.times, chosen = np.unique(np.concatenate(times), return_index=True)
        self._numbers = numbers.reshape(-1, _NUMBERS)[chosen]
        self._added.clear()

    def at(self, stamps: IntArray, gap_s: float) -> tuple[FloatArray, BoolArray]:
        """Poses (N, 4, 4) at times (N,), and whether (N,) they are known."""
        known_at, numbers = self.times, self._numbers
        if len(known_at) == 0:
            assert self._static is not None
            poses = compose(rotation_matrices(self._static[1][None, 3:]), self._static[1][None, :3])
            return np.repeat(poses, len(stamps), axis=0), np.ones(len(stamps), dtype=bool)
        after = np.searchsorted(known_at, stamps)
        left = np.clip(after - 1, 0, len(known_at) - 1)
        right = np.clip(after, 0, len(known_at) - 1)
        left = np.where(known_at[right] == stamps, right, left)
        to_left = (stamps - known_at[left]) / _NANOSECONDS
        span = (known_at[right] - known_at[left]) / _NANOSECONDS
        near = np.where(left == right, np.abs(to_left) <= gap_s, span <= gap_s)
        first, second = numbers[left], numbers[right]
        fraction = np.where(span > 0.0, np.clip(to_left / np.where(span > 0.0, span, 1.0), 0, 1), 0)
        position = first[:, :3] + fraction[:, None] * (second[:, :3] - first[:, :3])
        return compose(
            rotation_matrices(slerp(first[:, 3:], second[:, 3:], fraction)), position
        ), near

    def nearest(self, stamp: int) -> float:
        """Seconds from a time to the nearest sample."""
        away = (self.times - stamp) / _NANOSECONDS
        return float(away[np.argmin(np.abs(away))])


def unit_quaternion(rows: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """The quaternion of a rotation, rows of three numbers or more; the stablest of four ways."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows[:3])
    ways = (1 + a - e - i, 1 - a + e - i, 1 - a - e + i, 1 + a + e + i)
    way = ways.index(max(ways))
    outer = (
        (ways[0], b + d, c + g, h - f),
        (b + d, ways[1], f + h, c - g),
        (c + g, f + h, ways[2], d - b),
        (h - f, c - g, d - b, ways[3]),
    )[way]
    length = math.sqrt(sum(value * value for value in outer))
    x, y, z, w = outer
    return x / length, y / length, z / length, w / length


def _agree(one: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (7,) are the same; a quaternion and its negative are."""
    same_side = other[3:] if one[3:] @ other[3:] >= 0.0 else -other[3:]
    return bool(
        np.abs(one[:3] - other[:3]).max() < _SAME and np.abs(one[3:] - same_side).max() < _SAME
    )


def _listed(names: list[str]) -> str:
    more = [f"{len(names) - _MOST_LISTED} more"] if len(names) > _MOST_LISTED else []
    return ", ".join(names[:_MOST_LISTED] + more) or "none"


class JointHistory:
    """Values of joints by time; a state holds until the next one."""

    def __init__(self, names: Sequence[str]) -> None:
        """names: of the joints that matter."""
        self._names = tuple(names)
        self._added: list[tuple[Received, Joints]] = []
        self._states: list[tuple[int, Joints]] = []

    def add(self, received: Received, positions: Mapping[str, float]) -> None:
        """Positions of a message; joints that it does not name stay where they were."""
        last = self._added[-1][1] if self._added else {}
        state = last | {name: positions[name] for name in self._names if name in positions}
        if state.keys() != last.keys() or any(
            abs(state[name] - last[name]) > MOVED for name in state
        ):
            self._added.append((received, state))

    def settle(self, clocks: ClockCorrection) -> None:
        """All positions were added; their times are those by the clocks."""
        times = [(clocks.time(received), state) for received, state in self._added]
        self._states = sorted(times, key=lambda state: state[0])

    def first(self) -> Joints:
        """The first state; empty if there is none."""
        return self._added[0][1] if self._added else {}

    def during(self, opens: int, closes: int) -> list[tuple[int, Joints]]:
        """States from a time to before another, with the times from which they hold.

        The first one holds from `opens` on; of very many, some are left out.
        """
        start = bisect_right(self._states, opens, key=lambda state: state[0]) - 1
        chosen = [state for state in self._states[max(start, 0) :] if state[0] < closes]
        if not chosen:
            return [(opens, self.first())]
        every = -(-len(chosen) // MOST_OF_A_PROBE)
        return [(opens, chosen[0][1]), *chosen[every::every]]
