"""The first pass over a log: all that is small, and whether the log has what its rig needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import IntArray
from runners.sensors.hand import HAND, HandModel
from runners.sensors.log.clocks import ClockCorrection, Clocks
from runners.sensors.log.lerobot import LeRobotEpisode
from runners.sensors.log.messages import Received, TransformMessage
from runners.sensors.log.motion import MotionLimits
from runners.sensors.log.probe_windows import ProbeWindow, marked_windows, timed_windows, whole_log
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.trajectory_files import trajectory_messages
from runners.sensors.log.transforms import JointHistory, TransformError, TransformTree
from runners.sensors.rig import Rig
from runners.sensors.session_report import LogWarnings

_TRANSFORMS = ("TFMessage", "TransformStamped", "FrameTransform", "FrameTransforms")
_FIRST = 10  # messages of a topic that are kept for sensors to look at
_MOST_LOST = 0.1  # of the poses of a sensor: more without a transform are a warning


@dataclass(frozen=True)
class SensorTopic:
    """A topic that a sensor reads."""

    name: str
    """Name in the log."""

    content: type[Any]
    """Class of its messages in `log/messages.py`; messages of other classes are not read."""

    use: str
    """Use of the topic, as messages to users say, such as "depth of camera"."""


class TopicReader(Protocol):
    """The part of a sensor that the first pass looks at."""

    @property
    def name(self) -> str:
        """Name under which it is counted and shown."""

    @property
    def topics(self) -> Sequence[SensorTopic]:
        """Topics that the log must have; messages of the first are the measurements."""

    @property
    def frame(self) -> str | None:
        """Frame of the measurements; None: that of the messages."""


class FirstPass:
    """Knowledge of a log before its measurements are read one by one."""

    tree: TransformTree
    """Transforms between all frames."""

    joints: JointHistory
    """Positions of the joints that move the hand."""

    clocks: ClockCorrection
    """Correction of the times of messages."""

    windows: list[ProbeWindow]
    """Times of the probes, at least one."""

    warnings: LogWarnings
    """Lines for the user, to which sensors add theirs."""

    folder: Path
    """Folder of the log."""

    def __init__(
        self,
        log: RawLog | LeRobotEpisode,
        rig: Rig,
        *,
        sensors: Sequence[TopicReader],
        hand: HandModel | None,
        warnings: LogWarnings,
    ) -> None:
        """Look through a log for what sensors and the hand need.

        Raise SessionError if topics, messages or transforms are missing.
        """
        self._log = log
        self._rig = rig
        self._sensors = sensors
        self.warnings = warnings
        self.folder = log.path.parent
        self.tree = TransformTree()
        self.joints = JointHistory(
            hand.joint_names if hand else (), hand.sliding if hand else frozenset()
        )
        self._first: dict[tuple[str, type[Any]], list[Received]] = {
            (topic.name, topic.content): [] for sensor in sensors for topic in sensor.topics
        }
        self._markers: list[tuple[Received, str]] = []
        clocks = Clocks(rig.clock)
        for received in log.messages(_topics(log, rig, sensors=sensors)):
            clocks.add(received)
            self._take(received)
        for trajectory in rig.trajectories:
            for received in trajectory_messages(trajectory, self.folder):
                self._take(received)
        self.clocks = clocks.correction()
        self.tree.settle(self.clocks)
        limits = MotionLimits(rig.max_speed, rig.max_turn)
        implausible = self.joints.settle(self.clocks, limits)
        for text in (*log.warnings, *self.clocks.warnings, *implausible):
            warnings.warn(text)
        for text, count in (self.tree.faults + self.joints.faults).items():
            warnings.warn(text, count)
        self._times: dict[str, IntArray] = {
            topic: np.sort(self.clocks.times(topic, log_times, stamps=stamps))
            for topic in (sensor.topics[0].name for sensor in sensors)
            for log_times, stamps in (clocks.of(topic),)
        }
        self._check_poses(limits)
        self.windows = self._windows()

    def measured(self) -> tuple[str, ...]:
        """Return the topics whose messages are measurements, for the second pass."""
        return tuple(self._times)

    def first(self, topic: SensorTopic) -> list[Received]:
        """Return the first messages of a topic, as they came, at most 10, until `release`."""
        return self._first[topic.name, topic.content]

    def release(self) -> None:
        """Release the first messages, once all sensors are prepared."""
        self._first.clear()

    def _take(self, received: Received) -> None:
        topic = received.topic
        content = received.content
        hand = self._rig.hand
        if isinstance(content, TransformMessage):
            if not content.child and hand is not None and topic == hand.pose:
                content = replace(content, child=hand.frame)
            if content.child:
                self.tree.add(received, content)
        elif isinstance(content, str) and topic == self._rig.markers:
            self._markers.append((received, content))
        elif isinstance(content, dict):
            self.joints.add(received, content)
        else:
            first = self._first.get((topic, type(content)))
            if first is not None and len(first) < _FIRST:
                first.append(received)

    def _check_poses(self, limits: MotionLimits) -> None:
        """Raise SessionError unless all sensors have messages, and a pose at one of their times.

        Leave out samples of their motions that are not plausible.
        """
        rig = self._rig
        frames: list[tuple[str, str, IntArray]] = []
        for sensor in self._sensors:
            topic = sensor.topics[0]
            first = self.first(topic)
            if not first:
                raise self.error(
                    f"topic {topic.name} of {sensor.name} gives no {topic.content.noun}", topic
                )
            content: Any = first[0].content
            frame = sensor.frame or content.frame
            if not frame:
                raise self.error(
                    f"messages on {topic.name} of {sensor.name} name no frame; accepted: the frame "
                    "of a transform, in the messages or as frame in the rig"
                )
            frames.append((sensor.name, frame, self._times[topic.name]))
        if rig.hand is not None and len(self.tree.times):
            frames.append((HAND, rig.hand.frame, self.tree.times))
        elif rig.hand is not None:
            self.warnings.warn("no transform of the log ever changes: the hand has no path")
        for name, frame, _ in frames:
            try:
                remarks = self.tree.check_motions(rig.world, [frame], limits=limits)
            except TransformError as error:
                raise self.error(f"{name}: {error}") from None
            for remark in remarks:
                self.warnings.warn(remark)
        for name, frame, times in frames:
            self._require_known(name, frame, times=times)

    def _require_known(self, name: str, frame: str, *, times: IntArray) -> None:
        world, gap = self._rig.world, self._rig.clock.gap
        try:
            known = self.tree.lookups(world, frame, stamps_ns=times, gap_s=gap)[1]
            if not known.any():
                self.tree.lookup(world, frame, stamp_ns=int(times[len(times) // 2]), gap_s=gap)
        except TransformError as error:
            raise self.error(f"{name}: {error}") from None
        lost = int((~known).sum())
        if lost <= _MOST_LOST * len(times):
            return
        once = " and ".join(self.tree.sent_once(world, frame))
        reason = f"{once} was sent once, which counts for {gap:g} s; accepted: on tf_static"
        if not once:
            try:
                self.tree.lookup(world, frame, stamp_ns=int(times[~known][0]), gap_s=gap)
            except TransformError as error:
                reason = str(error)
        self.warnings.warn(
            f"{name}: {lost} of {len(times)} poses of {frame} are not known, and left out: {reason}"
        )

    def _windows(self) -> list[ProbeWindow]:
        """Return the probes of the log; all of it is one without markers."""
        rig = self._rig
        warnings = self.warnings
        begin = self._log.begin + self.clocks.typical
        end = self._log.end + self.clocks.typical
        first = min([begin, *(int(times[0]) for times in self._times.values())])
        last = max([end, *(int(times[-1]) for times in self._times.values())])
        windows: list[ProbeWindow] = []
        if rig.probes is not None:
            windows = timed_windows(rig.probes, begin, last=last, warnings=warnings)
        elif rig.markers:
            markers = [(self.clocks.time(received), text) for received, text in self._markers]
            windows = marked_windows(markers, first, last=last, warnings=warnings)
            if not windows:
                warnings.warn(f"topic {rig.markers} marks no probe: the whole log is one")
        return windows or whole_log(first, last)

    def error(self, text: str, topic: SensorTopic | None = None) -> SessionError:
        """Return an error about the log; topic: whose faults, or else schema, are added."""
        if topic is not None:
            faults = [fault for fault in self._log.faults if fault.startswith(f"{topic.name}: ")]
            schema = f"its schema is {self._log.topics[topic.name]}"
            text += f" ({faults[0].removeprefix(f'{topic.name}: ') if faults else schema})"
        return SessionError(f"log {self._log.path}: {text}")


def _topics(log: RawLog | LeRobotEpisode, rig: Rig, *, sensors: Sequence[TopicReader]) -> set[str]:
    """Return the topics to read: those that sensors, the hand and markers need, and transforms.

    Raise SessionError if the log lacks one of them.
    """
    uses: dict[str | None, str] = {
        topic.name: topic.use for sensor in sensors for topic in sensor.topics
    }
    if rig.hand is not None:
        uses |= {rig.hand.pose: "pose of the hand", rig.hand.joints: "joints of the hand"}
    if rig.probes is None:
        uses[rig.markers] = "markers of probes"
    topics = {topic: use for topic, use in uses.items() if topic}
    missing = [f"{topic} ({use})" for topic, use in topics.items() if topic not in log.topics]
    if missing:
        raise SessionError(
            f"log {log.path} lacks what rig {rig.name} names: {', '.join(missing)}; it has "
            f"{log.listing()}"
        )
    kinds = {name: schema.replace(".", "/") for name, schema in log.topics.items()}
    return {*topics, *(name for name, kind in kinds.items() if kind.split("/")[-1] in _TRANSFORMS)}
