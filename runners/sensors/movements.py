"""What of a log is looked up by its time: transforms, poses of the hand, and joints."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np

from chsel.numerics.arrays import IntArray
from runners.sensors.clocks import ClockCorrection
from runners.sensors.joint_history import JointHistory
from runners.sensors.messages import JointsMessage, PoseMessage, Received, TransformMessage
from runners.sensors.rig import Rig
from runners.sensors.transforms import TransformTree


class Movements:
    """Where frames and joints were. topics: those that told."""

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
