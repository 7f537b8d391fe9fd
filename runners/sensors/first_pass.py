"""The first pass over a log: all that is small, and whether the log has what its rig needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.sensing.depth_camera import PinholeCamera, valid_pixels
from runners.sensors.depth_camera import metres
from runners.sensors.log.clocks import Clocks
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    Received,
    TransformMessage,
    WrenchMessage,
)
from runners.sensors.log.probe_windows import ProbeWindow, marked_windows, timed_windows, whole_log
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.transforms import JointHistory, TransformError, TransformTree
from runners.sensors.pad import membrane_reference
from runners.sensors.rig import BubbleRig, CameraRig, Rig
from runners.sensors.session_report import LogWarnings

Progress = Callable[[int, int], None]

_TRANSFORMS = ("TFMessage", "TransformStamped", "FrameTransform", "FrameTransforms")
_OWN_SCHEMAS = "chsel."
_LATE = 1.5  # median intervals after which an image is missing


class FirstPass:
    """What is known of a log before its images are read.

    tree: of all frames. joints: those that move the hand. clocks: how times are corrected.
    windows: of the probes. cameras, references: by the names of sensors, the latter (H, W) in
    metres of the untouched membranes of pads. bulky: topics for the second pass.
    """

    def __init__(
        self,
        log: RawLog,
        rig: Rig,
        joint_names: Sequence[str],
        warnings: LogWarnings,
        progress: Progress,
    ) -> None:
        """Look through a log. joint_names: of the joints that move the hand.

        Raises SessionError if topics, camera infos or transforms are missing, or depths are no
        depths.
        """
        self._log, self._rig, self._warnings = log, rig, warnings
        self.tree, self.joints = TransformTree(), JointHistory(joint_names)
        self._sensed = {sensor.depth: _Sensed(ImageMessage) for sensor in rig.sensors}
        self._sensed |= {cloud.topic: _Sensed(CloudMessage) for cloud in rig.clouds}
        self._sensed |= {force.topic: _Sensed(WrenchMessage) for force in rig.forces}
        self._infos: dict[str, CameraInfoMessage] = {}
        self._changed_infos: Counter[str] = Counter()
        self._markers: list[tuple[Received, str]] = []
        clocks = Clocks(rig.clock)
        for received in log.messages(_topics(log, rig), progress=progress):
            clocks.add(received)
            self._take(received)
        self.bulky = tuple(self._sensed)
        self.clocks = clocks.correction()
        self.tree.settle(self.clocks)
        self.joints.settle(self.clocks)
        for topic, sensed in self._sensed.items():
            if sensed.count:
                sensed.times = np.sort(self.clocks.times(topic, *clocks.of(topic)))
        for text in (*log.warnings, *self.clocks.warnings):
            warnings.warn(text)
        for text, count in self.tree.faults.items():
            warnings.warn(text, count)
        self._check_sensors()
        self.windows = self._windows()
        self.cameras = {sensor.name: self._camera(sensor) for sensor in rig.sensors}
        self.references = {pad.name: self._reference(pad) for pad in rig.bubbles}

    def _take(self, received: Received) -> None:
        topic, content, hand = received.topic, received.content, self._rig.hand
        if isinstance(content, PoseMessage) and hand is not None and topic == hand.pose:
            content = TransformMessage(content.frame, hand.frame, content.frame_from_body)
        if isinstance(content, TransformMessage):
            self.tree.add(received, content)
        elif isinstance(content, JointsMessage) and hand is not None and topic == hand.joints:
            self.joints.add(received, content.positions)
        elif isinstance(content, MarkerMessage) and topic == self._rig.markers:
            self._markers.append((received, content.text))
        elif isinstance(content, CameraInfoMessage):
            self._changed_infos[topic] += self._infos.setdefault(topic, content) != content
        elif topic in self._sensed and isinstance(content, self._sensed[topic].kind):
            sensed = self._sensed[topic]
            sensed.frame = content.frame if sensed.frame is None else sensed.frame
            sensed.count += 1
            if isinstance(content, ImageMessage):
                height, width = content.values.shape
                sensed.sizes[height, width] += 1
                if len(sensed.first) < self._rig.contact.reference_images:
                    sensed.first.append((received, content.values))
                if sensed.count.bit_count() == 1:
                    sensed.samples.append(content.values)

    def _check_sensors(self) -> None:
        """Messages of every sensor, units, and the poses of sensors and hand."""
        for sensor in self._rig.sensors:
            self._check_topic(sensor.name, sensor.depth, "depth images", sensor.frame)
            suspicious = _suspicious_unit(sensor, self._sensed[sensor.depth].samples)
            if suspicious:
                self._warnings.warn(suspicious)
            times = self._sensed[sensor.depth].times
            lost = missing_images(times)
            if lost:
                self._warnings.note(
                    f"{sensor.name}: about {lost} of {len(times) + lost} images are missing"
                )
        for cloud in self._rig.clouds:
            self._check_topic(cloud.topic, cloud.topic, "points", None)
        for force in self._rig.forces:
            self._check_topic(force.topic, force.topic, "forces", force.frame)
        if self._rig.hand is not None:
            if len(self.tree.times):
                self._require_known("hand", self._rig.hand.frame, self.tree.times)
            else:
                self._warnings.warn("no transform of the log ever changes: the hand has no path")

    def _check_topic(self, name: str, topic: str, what: str, frame: str | None) -> None:
        """A sensor has messages, and its pose is known at one of their times at least."""
        sensed = self._sensed[topic]
        if not sensed.count:
            raise self._error(f"topic {topic} of {name} gives no {what}{self._reason(topic)}")
        frame = frame or sensed.frame
        if not frame:
            raise self._error(
                f"messages on {topic} of {name} name no frame; accepted: the frame of a "
                "transform, in the messages or as frame in the rig"
            )
        self._require_known(name, frame, sensed.times)

    def _require_known(self, name: str, frame: str, times: IntArray) -> None:
        world, gap = self._rig.world, self._rig.clock.gap
        try:
            if not self.tree.lookups(world, frame, times, gap_s=gap)[1].any():
                self.tree.lookup(world, frame, int(times[len(times) // 2]), gap_s=gap)
        except TransformError as error:
            raise self._error(f"{name}: {error}") from None

    def _reason(self, topic: str) -> str:
        """What was wrong with the messages of a topic, or what they are."""
        for fault in self._log.faults:
            if fault.startswith(f"{topic}: "):
                return f" ({fault.removeprefix(f'{topic}: ')})"
        return f" (its schema is {self._log.topics[topic].schema})"

    def _camera(self, sensor: CameraRig | BubbleRig) -> PinholeCamera:
        """The intrinsics of a sensor, which fit its images."""
        info = self._infos.get(sensor.info)
        if info is None:
            raise self._error(
                f"no camera info of {sensor.name} on topic {sensor.info}{self._reason(sensor.info)}"
            )
        sizes = self._sensed[sensor.depth].sizes
        if (info.camera.height, info.camera.width) not in sizes:
            (height, width), _ = sizes.most_common(1)[0]
            raise self._error(
                f"images of {sensor.name} have {width} x {height} pixels, and its camera info says "
                f"{info.camera.width} x {info.camera.height}; accepted: the same"
            )
        if info.distorted:
            self._warnings.warn(
                f"{sensor.name}: its camera info names a distortion, which is not undone"
            )
        self._warnings.warn(
            f"{sensor.name}: another camera info than the first", self._changed_infos[sensor.info]
        )
        return info.camera

    def _windows(self) -> list[ProbeWindow]:
        """The probes of the log; all of it is one without markers."""
        rig, warnings = self._rig, self._warnings
        begin, end = (time + self.clocks.typical for time in (self._log.begin, self._log.end))
        times = [sensed.times for sensed in self._sensed.values()]
        first = min([begin, *(int(topic[0]) for topic in times)])
        last = max([end, *(int(topic[-1]) for topic in times)])
        windows: list[ProbeWindow] = []
        if rig.probes is not None:
            windows = timed_windows(rig.probes, begin, last, warnings)
        elif rig.markers:
            markers = [(self.clocks.time(received), text) for received, text in self._markers]
            windows = marked_windows(markers, first, last, warnings)
            if not windows:
                warnings.warn(f"topic {rig.markers} marks no probe: the whole log is one")
        return windows or whole_log(first, last)

    def _reference(self, pad: BubbleRig) -> FloatArray:
        """The depth image of an untouched membrane."""
        camera = self.cameras[pad.name]
        fitting = [
            (self.clocks.time(received), values)
            for received, values in self._sensed[pad.depth].first
            if values.shape == (camera.height, camera.width)
        ]
        untouched = [values for time, values in fitting if time < self.windows[0].begin]
        if pad.reference is None and pad.kind == "depth" and not untouched:
            untouched = [values for _, values in fitting]
            self._warnings.warn(
                f"{pad.name}: no image before the first probe; its reference is made of the first "
                f"{len(untouched)} of the probe"
            )
        return membrane_reference(pad, untouched, camera, self._log.path.parent)

    def _error(self, text: str) -> SessionError:
        return SessionError(f"log {self._log.path}: {text}")


def _topics(log: RawLog, rig: Rig) -> set[str]:
    """The topics that a rig needs, of which the log has all; those of transforms besides."""
    if any(topic.schema.startswith(_OWN_SCHEMAS) for topic in log.topics.values()):
        raise SessionError(
            f"log {log.path} is a recording of a session, not a robot's log; accepted: "
            f"session=recorded session.path={log.path}"
        )
    if not (rig.cameras or rig.bubbles or rig.clouds or rig.hand):
        raise SettingError(
            f"rig {rig.name} has no sensor; accepted: at least one of cameras, bubbles, clouds, "
            "hand"
        )
    named = {}
    for sensor in rig.sensors:
        named[sensor.depth] = f"depth of {sensor.name}"
        named[sensor.info] = f"camera info of {sensor.name}"
    named |= {cloud.topic: "points" for cloud in rig.clouds}
    named |= {force.topic: "forces" for force in rig.forces}
    if rig.hand is not None and rig.hand.pose:
        named[rig.hand.pose] = "pose of the hand"
    if rig.hand is not None and rig.hand.joints:
        named[rig.hand.joints] = "joints of the hand"
    if rig.markers and rig.probes is None:
        named[rig.markers] = "markers of probes"
    missing = [f"{topic} ({user})" for topic, user in named.items() if topic not in log.topics]
    if missing:
        raise SessionError(
            f"log {log.path} lacks what rig {rig.name} names: {', '.join(missing)}; it has "
            f"{log.listing()}"
        )
    kinds = {name: topic.schema.replace(".", "/") for name, topic in log.topics.items()}
    return {*named, *(name for name, kind in kinds.items() if kind.split("/")[-1] in _TRANSFORMS)}


@dataclass
class _Sensed:
    """The messages of a topic of images, clouds or forces."""

    kind: type[ImageMessage | CloudMessage | WrenchMessage]
    count: int = 0
    frame: str | None = None  # of the first message
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)  # (H, W) of images
    first: list[tuple[Received, np.ndarray]] = field(default_factory=list)  # a few images
    samples: list[np.ndarray] = field(default_factory=list)  # images 1, 2, 4, 8, ...
    times: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,), nanoseconds, ascending."""


def missing_images(times: IntArray) -> int:
    """About how many are missing between times (N,), ascending, of images at a steady rate."""
    intervals = np.diff(times)
    usual = float(np.median(intervals)) if len(intervals) > 1 else 0.0
    if usual <= 0.0:
        return 0
    late = intervals[intervals > _LATE * usual]
    return int((np.rint(late / usual) - 1.0).sum())


_LEAST_WITHIN = 0.01  # of the numbers, or else these are no depths in metres


def _suspicious_unit(rig: CameraRig | BubbleRig, samples: list[np.ndarray]) -> str | None:
    """What is suspicious about images (H, W) of a sensor, as they were sent; None if nothing is.

    Raises SessionError if there are numbers, and next to none of them is a depth within range.
    """
    if isinstance(rig, BubbleRig) and rig.kind == "deformation":
        return None
    images = [metres(values, rig.unit) for values in samples]
    measured = [image[np.isfinite(image) & (image > 0.0)] for image in images]
    medians = [float(np.median(depths)) for depths in measured if len(depths)]
    if not medians:
        return f"{rig.name}: no image that was looked at has a measurement"
    nearest, furthest = rig.range
    within = valid_pixels(np.concatenate(measured), nearest=nearest, furthest=furthest)
    if within.mean() >= _LEAST_WITHIN:
        return None
    unit = metres(np.ones(1, samples[-1].dtype), rig.unit)[0]
    raise SessionError(
        f"topic {rig.depth} of {rig.name} has depths of {np.median(medians):.4g} m (median, at "
        f"{unit:g} m a unit); accepted: from {nearest:g} to {furthest:g} m, its range: set unit, "
        "the metres of a unit of its images, or range"
    )
