"""Poses of frames and positions of joints over time, from the messages of a log."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.problem.poses import compose, inverse, quaternions, rotation_matrices, slerp
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import Joints, Received, TransformMessage
from runners.sensors.log.motion import MotionLimits, check_motion

_NANOSECONDS = 1e9
_MOST_LISTED = 30
_SAME = 1e-6  # metres, and parts of a rotation matrix
_ELSEWHERE = 0.01  # the same: by which two poses at one time are contradictory

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_OF_A_PROBE = 50


class TransformError(SessionError):
    """A pose cannot be had from the transforms of a log."""


class TransformTree:
    """Poses of frames in one another at any time."""

    faults: Counter[str]
    """How often transforms contradicted others, of which the first count, by text."""

    times: IntArray
    """Times (T,) of all transforms that move, nanoseconds, ascending."""

    def __init__(self) -> None:
        self.faults = Counter()
        self.times = np.zeros(0, dtype=np.int64)
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
        """Correct the times of all transforms that were added by the clocks."""
        for child, edge in self._edges.items():
            edge.settle(clocks)
            if edge.is_static_and_moves():
                self.faults[f"frame {child} is both static and moving; what moves counts"] += 1
        self._gather_times()

    def check_motions(
        self, world: str, frames: Iterable[str], *, limits: MotionLimits
    ) -> list[str]:
        """Leave out implausible samples of the transforms between frames and the world.

        Return what a user should know of them. Raise TransformError as `lookup` does.
        """
        paths = (self._path(world, frame) for frame in frames)
        children = dict.fromkeys(child for path in paths for part in path for child in part)
        remarks = [self._edges[child].check_motion(child, limits) for child in children]
        self._gather_times()
        return [remark for some in remarks for remark in some]

    def jumps(self, target: str, source: str) -> IntArray:
        """Return times (J,), ascending, until which the motion of a frame is not known.

        Raise TransformError as `lookup` does.
        """
        down, up = self._path(target, source)
        times = [self._edges[child].jump_times() for child in (*down, *up)]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *times]))

    def sent_once(self, target: str, source: str) -> list[str]:
        """Return transforms between two frames that are not static, and were sent a single time."""
        down, up = self._path(target, source)
        edges = {child: self._edges[child] for child in (*down, *up)}
        return [f"{name} in {edge.parent}" for name, edge in edges.items() if len(edge.times) == 1]

    def _gather_times(self) -> None:
        times = [edge.times for edge in self._edges.values()]
        self.times = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *times]))

    def lookup(self, target: str, source: str, *, stamp_ns: int, gap_s: float) -> FloatArray:
        """Return target_from_source (4, 4) at a time, nanoseconds.

        Linear in position and along the shorter arc of rotation between samples at most `gap_s`
        seconds apart; before the first and after the last sample, by at most `gap_s`, as they are.
        Raise TransformError if a frame is unknown, not connected, or not known at that time.
        """
        stamps = np.array([stamp_ns])
        poses, valid = self.lookups(target, source, stamps_ns=stamps, gap_s=gap_s)
        if not valid[0]:
            down, up = self._path(target, source)
            edges = [(child, self._edges[child]) for child in (*down, *up)]
            child, edge = next(one for one in edges if not one[1].at(stamps, gap_s)[1][0])
            if len(edge.times) == 0:
                raise TransformError(
                    f"{target} from {source}: no sample is left: {'; '.join(edge.remarks)}"
                )
            away = edge.nearest(stamp_ns)
            raise TransformError(
                f"{target} from {source}: {child} in {edge.parent} is not known at "
                f"{stamp_ns / _NANOSECONDS:.3f} s; the nearest is {abs(away):.3f} s "
                f"{'before' if away < 0 else 'after'}, and gaps of up to {gap_s:g} s are bridged"
            )
        pose: FloatArray = poses[0]
        return pose

    def lookups(
        self, target: str, source: str, *, stamps_ns: IntArray, gap_s: float
    ) -> tuple[FloatArray, BoolArray]:
        """Return target_from_source (N, 4, 4) at times (N,), NaN if unknown, and which are known.

        Raise TransformError if a frame is unknown or not connected to the other.
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
                root = parent_from_child @ root
                valid = valid & known
            poses = inverse(root) @ poses if flip else root @ poses
        poses[~valid] = np.nan
        return poses, valid

    def _ancestry(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on to the root of its tree."""
        found = [frame]
        while (edge := self._edges.get(found[-1])) is not None:
            found.append(edge.parent)
        return found

    def _path(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the children of the transforms from each frame up to where their ways meet."""
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
        self._jumps: BoolArray = np.zeros(0, dtype=bool)  # (N,), before which there is a jump
        self._contradicting: tuple[IntArray, FloatArray, FloatArray] | None = None
        """Times, positions and quaternions of other poses at times (C,) of samples."""

        self.remarks: list[str] = []  # on samples that are left out
        self._topics: tuple[str, ...] = ()
        self._static: tuple[int, FloatArray] | None = None  # stamp, pose
        self._added: dict[str, tuple[array[int], array[int], array[float]]] = {}
        """The log's times, stamps and poses (4, 4) by topic."""

    def add(self, received: Received, message: TransformMessage) -> bool:
        """Add a pose, of static ones the latest; return whether it agrees with earlier ones."""
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
        times = [
            clocks.times(topic, log_times, stamps=stamps)
            for topic, (log_times, stamps, _) in self._added.items()
        ]
        numbers = np.concatenate([np.frombuffer(some[2]) for some in self._added.values()])
        every = np.concatenate(times)
        self.times, chosen, sample = np.unique(every, return_index=True, return_inverse=True)
        poses = numbers.reshape(-1, 4, 4)
        apart = np.flatnonzero(
            (np.abs(poses - poses[chosen][sample]) > _ELSEWHERE).any(axis=(1, 2))
        )
        if len(apart):
            others = poses[apart]
            self._contradicting = every[apart], others[:, :3, 3], quaternions(others[:, :3, :3])
        poses = poses[chosen]
        self._positions = poses[:, :3, 3]
        self._quaternions = quaternions(poses[:, :3, :3])
        self._jumps = np.zeros(len(self.times), dtype=bool)
        self._topics = tuple(self._added)
        self._added.clear()

    def is_static_and_moves(self) -> bool:
        """Return whether it is static in one place, and was also sent in another one."""
        if self._static is None or len(self.times) == 0:
            return False
        return bool((np.abs(self._positions - self._static[1][:3, 3]) > _ELSEWHERE).any())

    def check_motion(self, child: str, limits: MotionLimits) -> list[str]:
        """Leave out samples that are not plausible; what a user should know of them."""
        times = self.times
        positions = self._positions
        turns = self._quaternions
        if self._contradicting is not None:
            others = self._contradicting
            self._contradicting = None
            order = np.argsort(np.concatenate([times, others[0]]), kind="stable")
            times = np.concatenate([times, others[0]])[order]
            positions = np.concatenate([positions, others[1]])[order]
            turns = np.concatenate([turns, others[2]])[order]

        def distances(first: IntArray, second: IntArray) -> FloatArray:
            away = np.sqrt(((positions[first] - positions[second]) ** 2).sum(axis=1))
            same = np.abs((turns[first] * turns[second]).sum(axis=1))
            return np.stack([away, 2.0 * np.arccos(np.minimum(same, 1.0))], axis=1)

        blank = (positions == 0.0).all(axis=1) & (np.abs(turns[:, 3]) == 1.0)
        found = check_motion(times, distances, limits=limits, blank=blank)
        topics = " and ".join(self._topics)
        remarks = found.remarks(f"{child} in {self.parent}, on {topics},", limits)
        self.remarks += remarks
        if remarks:
            self._jumps = found.jumps[found.kept]
            self._positions, self._quaternions = positions[found.kept], turns[found.kept]
            self.times = times[found.kept]
        return remarks

    def jump_times(self) -> IntArray:
        """Return times (J,) of samples that the ones before them cannot have reached."""
        return self.times[self._jumps]

    def at(self, stamps: IntArray, gap_s: float) -> tuple[FloatArray, BoolArray]:
        """Return poses (N, 4, 4) at times (N,), and whether (N,) they are known."""
        known_at = self.times
        if len(known_at) == 0:
            pose = np.eye(4) if self._static is None else self._static[1]
            known = np.full(len(stamps), self._static is not None)
            return np.repeat(pose[None], len(stamps), axis=0), known
        after = np.searchsorted(known_at, stamps)
        left = np.clip(after - 1, 0, len(known_at) - 1)
        right = np.clip(after, 0, len(known_at) - 1)
        left = np.where(known_at[right] == stamps, right, left)
        to_left = (stamps - known_at[left]) / _NANOSECONDS
        span = (known_at[right] - known_at[left]) / _NANOSECONDS
        bridged = (span <= gap_s) & ~self._jumps[right]
        near = np.where(left == right, np.abs(to_left) <= gap_s, bridged)
        fraction = np.where(span > 0.0, np.clip(to_left / np.where(span > 0.0, span, 1.0), 0, 1), 0)
        first, second = self._positions[left], self._positions[right]
        position = first + fraction[:, None] * (second - first)
        turned = slerp(self._quaternions[left], self._quaternions[right], fraction=fraction)
        return compose(rotation_matrices(turned), position), near

    def nearest(self, stamp: int) -> float:
        """Return seconds from a time to the nearest sample."""
        away = (self.times - stamp) / _NANOSECONDS
        return float(away[np.argmin(np.abs(away))])


def _listed(names: list[str]) -> str:
    more = [f"{len(names) - _MOST_LISTED} more"] if len(names) > _MOST_LISTED else []
    return ", ".join(names[:_MOST_LISTED] + more) or "none"


class JointHistory:
    """Values of joints by time; a state holds until the next one."""

    faults: Counter[str]
    """How often values were not finite, by text."""

    def __init__(self, names: Sequence[str], sliding: Collection[str] = ()) -> None:
        """Make a history of joints, by their names; sliding: those that are prismatic."""
        self._names, self._sliding = tuple(names), frozenset(sliding)
        self.faults = Counter()
        self._added: list[tuple[Received, Joints]] = []
        self._repeated: Received | None = None  # the last message, where it said nothing new
        self._states: list[tuple[int, Joints | None]] = []
        """Times and positions; None: not known."""

    def add(self, received: Received, positions: Mapping[str, float]) -> None:
        """Add positions of a message; joints that it does not name stay where they were."""
        last = self._added[-1][1] if self._added else {}
        known = {name: positions[name] for name in self._names if name in positions}
        state = last | {name: value for name, value in known.items() if math.isfinite(value)}
        self.faults.update(
            f"{received.topic}: joint {name} is not a finite number; it counts as unmoved"
            for name, value in known.items()
            if not math.isfinite(value)
        )
        if state.keys() != last.keys() or any(
            abs(state[name] - last[name]) > MOVED for name in state
        ):
            if self._repeated is not None:
                self._added.append((self._repeated, last))
            self._added.append((received, state))
            self._repeated = None
        else:
            self._repeated = received

    def settle(self, clocks: ClockCorrection, limits: MotionLimits) -> list[str]:
        """Return correct the times of all positions that were added by the clocks.

        States that are not plausible are left out; returns what a user should know of them.
        """
        timed = [(clocks.time(received), state) for received, state in self._added]
        timed.sort(key=lambda state: state[0])
        values = np.array([[state.get(n, np.nan) for n in self._names] for _, state in timed])
        values = values.reshape(len(timed), len(self._names))
        slides = np.array([name in self._sliding for name in self._names], dtype=bool)

        def distances(first: IntArray, second: IntArray) -> FloatArray:
            apart = np.nan_to_num(np.abs(values[first] - values[second]))  # 0 if one is unknown
            turned = np.abs((apart + np.pi) % (2.0 * np.pi) - np.pi)  # a joint may turn on and on
            ways = np.where(slides, apart, 0.0), np.where(slides, 0.0, turned)
            return np.stack([way.max(axis=1, initial=0.0) for way in ways], axis=1)

        times = np.array([time for time, _ in timed], dtype=np.int64)
        found = check_motion(times, distances, limits=limits)
        before: Joints | None = {}
        for (time, state), kept, disputed in zip(timed, found.kept, found.disputed, strict=True):
            chosen = None if disputed else state if kept else before
            if chosen is not before:
                self._states.append((time, chosen))
            before = chosen
        topics = " and ".join(dict.fromkeys(received.topic for received, _ in self._added))
        return found.remarks(f"the hand's joints, on {topics},", limits)

    def first(self) -> Joints:
        """Return the first state that is known; empty if there is none."""
        return next((state for _, state in self._states if state is not None), {})

    def during(self, opens: int, closes: int) -> list[tuple[int, Joints | None]]:
        """Return states from a time to before another, with the times from which they hold.

        The first one holds from `opens` on; of very many, some are left out. None: not known.
        """
        start = bisect_right(self._states, opens, key=lambda state: state[0]) - 1
        chosen = [state for state in self._states[max(start, 0) :] if state[0] < closes]
        if not chosen:
            return [(opens, self._states[0][1] if self._states else {})]
        every = -(-len(chosen) // MOST_OF_A_PROBE)
        return [(opens, chosen[0][1]), *chosen[every::every]]
