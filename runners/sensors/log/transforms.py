"""Where frames and joints of a robot were over time, from the messages of a log."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.problem.poses import compose, inverse, quaternions, rotation_matrices, slerp
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import Joints, Received, TransformMessage

_NANOSECONDS = 1e9
_MOST_LISTED = 30
_SAME = 1e-6  # metres, and parts of a rotation matrix

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_OF_A_PROBE = 50


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
        if edge.parent != parent:
            self.faults[f"frame {child} has two parents, {edge.parent} and {parent}"] += 1
        elif not edge.add(received, message):
            self.faults[f"frame {child} is static in several places"] += 1

    def settle(self, clocks: ClockCorrection) -> None:
        """All transforms were added; their times are those by the clocks."""
        for edge in self._edges.values():
            edge.settle(clocks)
        times = [edge.times for edge in self._edges.values()]
        self.times = np.unique(np.concatenate([self.times, *times]))

    def lookup(self, target: str, source: str, stamp_ns: int, *, gap_s: float) -> FloatArray:
        """target_from_source (4, 4) at a time, nanoseconds.

        Linear in position and along the shorter arc of rotation between samples at most `gap_s`
        seconds apart; before the first and after the last sample, by at most `gap_s`, as they are.
        Raises TransformError if a frame is unknown, not connected, or not known at that time.
        """
        stamps = np.array([stamp_ns])
        poses, valid = self.lookups(target, source, stamps, gap_s=gap_s)
        if not valid[0]:
            down, up = self._path(target, source)
            edges = [(child, self._edges[child]) for child in (*down, *up)]
            child, edge = next(one for one in edges if not one[1].at(stamps, gap_s)[1][0])
            away = edge.nearest(stamp_ns)
            raise TransformError(
                f"{target} from {source}: {child} in {edge.parent} is not known at "
                f"{stamp_ns / _NANOSECONDS:.3f} s; the nearest is {abs(away):.3f} s "
                f"{'before' if away < 0 else 'after'}, and gaps of up to {gap_s:g} s are bridged"
            )
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
                for root in (from_target[-1], from_source[-1])
            )
            raise TransformError(
                f"frames {target} and {source} are not connected, but in two trees: {trees}"
            )
        shared = set(from_target) & set(from_source)
        return (
            [name for name in from_target if name not in shared],
            [name for name in from_source if name not in shared],
        )


class _Edge:
    """Poses of one frame in its parent's over time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.times: IntArray = np.zeros(0, dtype=np.int64)  # (N,), rising
        self._positions: FloatArray = np.zeros((0, 3))
        self._quaternions: FloatArray = np.zeros((0, 4))
        self._static: tuple[int, FloatArray] | None = None  # stamp, pose
        self._added: dict[str, tuple[array[int], array[int], array[float]]] = {}
        """The log's times, stamps and poses (4, 4) by topic."""

    def add(self, received: Received, message: TransformMessage) -> bool:
        """Whether the pose agrees with earlier ones; of static ones the latest holds."""
        pose = message.parent_from_child
        if message.static:
            stamp = received.stamp or received.log_time
            before = self._static or (stamp, pose)
            self._static = (stamp, pose) if stamp >= before[0] else before
            return bool(np.abs(before[1] - pose).max() < _SAME)
        added = self._added.setdefault(received.topic, (array("q"), array("q"), array("d")))
        added[0].append(received.log_time)
        added[1].append(received.stamp or 0)
        added[2].frombytes(pose.tobytes())
        return True

    def settle(self, clocks: ClockCorrection) -> None:
        """Sort the poses by time; of equal times the first that came counts."""
        if not self._added:
            return
        times = [clocks.times(topic, *some[:2]) for topic, some in self._added.items()]
        numbers = np.concatenate([np.frombuffer(some[2]) for some in self._added.values()])
        self.times, chosen = np.unique(np.concatenate(times), return_index=True)
        poses = numbers.reshape(-1, 4, 4)[chosen]
        self._positions, self._quaternions = poses[:, :3, 3], quaternions(poses[:, :3, :3])
        self._added.clear()

    def at(self, stamps: IntArray, gap_s: float) -> tuple[FloatArray, BoolArray]:
        """Poses (N, 4, 4) at times (N,), and whether (N,) they are known."""
        known_at = self.times
        if len(known_at) == 0:
            assert self._static is not None
            return np.repeat(self._static[1][None], len(stamps), axis=0), np.ones(len(stamps), bool)
        after = np.searchsorted(known_at, stamps)
        left = np.clip(after - 1, 0, len(known_at) - 1)
        right = np.clip(after, 0, len(known_at) - 1)
        left = np.where(known_at[right] == stamps, right, left)
        to_left = (stamps - known_at[left]) / _NANOSECONDS
        span = (known_at[right] - known_at[left]) / _NANOSECONDS
        near = np.where(left == right, np.abs(to_left) <= gap_s, span <= gap_s)
        fraction = np.where(span > 0.0, np.clip(to_left / np.where(span > 0.0, span, 1.0), 0, 1), 0)
        first, second = self._positions[left], self._positions[right]
        position = first + fraction[:, None] * (second - first)
        turned = slerp(self._quaternions[left], self._quaternions[right], fraction)
        return compose(rotation_matrices(turned), position), near

    def nearest(self, stamp: int) -> float:
        """Seconds from a time to the nearest sample."""
        away = (self.times - stamp) / _NANOSECONDS
        return float(away[np.argmin(np.abs(away))])


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
