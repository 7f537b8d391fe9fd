"""What of a log is looked up by its time: transforms, poses of the hand, and joints."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Mapping, Sequence

import numpy as np

from chsel.numerics.arrays import IntArray
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import JointsMessage, PoseMessage, Received, TransformMessage
from runners.sensors.log.transforms import TransformTree
from runners.sensors.rig import Rig

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_STATES = 100_000  # of a log
MOST_OF_A_PROBE = 50

Joints = dict[str, float]


class JointHistory:
    """Values of joints by time; a state holds until the next one."""

    def __init__(self, names: Sequence[str]) -> None:
        """names: of the joints that matter."""
        self._names = tuple(names)
        self._states: list[tuple[int, Joints]] = []

    def add(self, time: int, positions: Mapping[str, float]) -> None:
        """Positions at a time; joints that it does not name stay where they were."""
        new = {name: positions[name] for name in self._names if name in positions}
        state = (self._states[-1][1] if self._states else {}) | new
        if new and len(self._states) < MOST_STATES and self._moved(state):
            self._states.append((time, state))

    def first(self) -> Joints:
        """The first state; empty if there is none."""
        return self._states[0][1] if self._states else {}

    def during(self, opens: int, closes: int) -> list[tuple[int, Joints]]:
        """States from a time to before another, with the times from which they hold.

        The first one holds from `opens` on; of very many, some are left out.
        """
        states = sorted(self._states, key=lambda state: state[0])
        times = [time for time, _ in states]
        start = bisect_right(times, opens) - 1
        chosen = [(time, joints) for time, joints in states[max(start, 0) :] if time < closes]
        if not chosen:
            return [(opens, self.first())]
        every = -(-len(chosen) // MOST_OF_A_PROBE)
        return [(opens, chosen[0][1]), *chosen[every::every]]

    def _moved(self, state: Joints) -> bool:
        if not self._states or state.keys() != self._states[-1][1].keys():
            return True
        last = self._states[-1][1]
        return any(abs(state[name] - last[name]) > MOVED for name in state)


class Movements:
    """Where frames and joints were. topics: those of such messages."""

    def __init__(self, rig: Rig, joint_names: Sequence[str]) -> None:
        """joint_names: of the joints that move the hand."""
        self.tree = TransformTree()
        self.joints = JointHistory(joint_names)
        self.topics: set[str] = set()
        self._rig, self._times = rig, array("q")
        self._offsets: dict[str, tuple[int, int]] = {}
        self._without_stamp = False

    def add(self, received: Received, time: int) -> None:
        """Take note of a message if it is of such a kind."""
        content, hand = received.content, self._rig.hand
        if isinstance(content, PoseMessage) and hand is not None and received.topic == hand.pose:
            content = TransformMessage(content.frame, hand.frame, content.frame_from_body)
        if isinstance(content, TransformMessage):
            self.tree.add(time, content)
            if not content.static and (not self._times or self._times[-1] != time):
                self._times.append(time)
        elif isinstance(content, JointsMessage) and hand and received.topic == hand.joints:
            self.joints.add(time, content.positions)
        else:
            return
        self.topics.add(received.topic)
        if isinstance(content, TransformMessage) and content.static:
            return
        if not received.stamp:
            self._without_stamp = True
            return
        offset = received.stamp - received.log_time
        least, most = self._offsets.get(received.topic, (offset, offset))
        self._offsets[received.topic] = min(least, offset), max(most, offset)

    def differs(self, clocks: ClockCorrection) -> bool:
        """Whether times by `clocks` differ from stamps, or from the log's without a stamp."""
        if self._without_stamp and clocks.typical:
            return True
        for topic, (least, most) in self._offsets.items():
            usual = clocks.medians.get(topic)
            if clocks.by_log or usual is None or clocks.of(topic):
                return True
            if max(most - usual, usual - least) > clocks.jump:
                return True
        return False

    def times(self) -> IntArray:
        """Times (T,) of all transforms that move, ascending, each once."""
        return np.unique(np.array(self._times, dtype=np.int64))
