"""The first pass over a log: all that is small, and whether the log has what its rig needs."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

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
    Received,
    TransformMessage,
    WrenchMessage,
)
from runners.sensors.log.motion import MotionLimits
from runners.sensors.log.probe_windows import ProbeWindow, marked_windows, timed_windows, whole_log
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.transforms import JointHistory, TransformError, TransformTree
from runners.sensors.pad import membrane_reference
from runners.sensors.rig import BubbleRig, ImageRig, Rig
from runners.sensors.session_report import LogWarnings

Progress = Callable[[int, int], None]

_TRANSFORMS = ("TFMessage", "TransformStamped", "FrameTransform", "FrameTransforms")
RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
_FIRST = 10  # images of a sensor that are looked at, and make up a missing reference
_MOST_LOST = 0.1  # of the poses of a sensor: more without a transform are a warning
_LEAST_WITHIN = 0.01  # of the numbers, or else these are no depths in metres


@dataclass
class _Sensed:
    """The messages of a topic of images, clouds or forces."""

    kind: type[ImageMessage | CloudMessage | WrenchMessage]
    what: str  # for messages to the user
    frame: str | None = None  # of the first message
    images: list[tuple[Received, np.ndarray]] = field(default_factory=list)  # the first
    times: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,), nanoseconds, ascending."""


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
        *,
        sliding: Collection[str] = (),
    ) -> None:
        """Look through a log. joint_names: of the joints that move the hand.

        sliding: those of them that are prismatic.

        Raises SessionError if topics, camera infos or transforms are missing, or depths are no
        depths.
        """
        self._log, self._rig, self._warnings = log, rig, warnings
        self.tree, self.joints = TransformTree(), JointHistory(joint_names, sliding)
        self._sensed = {
            sensor.depth: _Sensed(ImageMessage, "depth images") for sensor in rig.sensors
        }
        self._sensed |= {cloud.topic: _Sensed(CloudMessage, "points") for cloud in rig.clouds}
        self._sensed |= {force.topic: _Sensed(WrenchMessage, "forces") for force in rig.forces}
        self._infos: dict[str, CameraInfoMessage] = {}
        self._markers: list[tuple[Received, str]] = []
        clocks = Clocks(rig.clock)
        for received in log.messages(_topics(log, rig), progress=progress):
            clocks.add(received)
            self._take(received)
        self.bulky = tuple(self._sensed)
        self.clocks = clocks.correction()
        self.tree.settle(self.clocks)
        limits = MotionLimits(rig.max_speed, rig.max_turn)
        implausible = self.joints.settle(self.clocks, limits)
        for text in (*log.warnings, *self.clocks.warnings, *implausible):
            warnings.warn(text)
        for text, count in (self.tree.faults + self.joints.faults).items():
            warnings.warn(text, count)
        for topic, sensed in self._sensed.items():
            sensed.times = np.sort(self.clocks.times(topic, *clocks.of(topic)))
        self._check_poses(limits)
        self.windows = self._windows()
        self.cameras = {sensor.name: self._camera(sensor) for sensor in rig.sensors}
        self.references = {pad.name: self._reference(pad) for pad in rig.bubbles}

    def _take(self, received: Received) -> None:
        topic, content, hand = received.topic, received.content, self._rig.hand
        if isinstance(content, TransformMessage):
            if not content.child and hand is not None and topic == hand.pose:
                content = replace(content, child=hand.frame)
            if content.child:
                self.tree.add(received, content)
        elif isinstance(content, CameraInfoMessage):
            self._infos.setdefault(topic, content)
        elif isinstance(content, str) and topic == self._rig.markers:
            self._markers.append((received, content))
        elif isinstance(content, dict):
            self.joints.add(received, content)
        elif topic in self._sensed and isinstance(content, self._sensed[topic].kind):
            sensed = self._sensed[topic]
            sensed.frame = content.frame if sensed.frame is None else sensed.frame
            if isinstance(content, ImageMessage) and len(sensed.images) < _FIRST:
                sensed.images.append((received, content.values))

    def _check_poses(self, limits: MotionLimits) -> None:
        """All sensors have messages, and their poses are known at one of their times at least.

        Leaves out samples of their motions that are not plausible.
        """
        rig, frames = self._rig, list[tuple[str, str, IntArray]]()
        sensors = [(sensor.name, sensor.depth, sensor.frame) for sensor in rig.sensors]
        sensors += [(cloud.topic, cloud.topic, None) for cloud in rig.clouds]
        sensors += [(force.topic, force.topic, force.frame) for force in rig.forces]
        for name, topic, frame in sensors:
            sensed = self._sensed[topic]
            if sensed.frame is None:
                raise self._error(f"topic {topic} of {name} gives no {sensed.what}", topic)
            frame = frame or sensed.frame
            if not frame:
                raise self._error(
                    f"messages on {topic} of {name} name no frame; accepted: the frame of a "
                    "transform, in the messages or as frame in the rig"
                )
            frames.append((name, frame, sensed.times))
        if rig.hand is not None and len(self.tree.times):
            frames.append(("hand", rig.hand.frame, self.tree.times))
        elif rig.hand is not None:
            self._warnings.warn("no transform of the log ever changes: the hand has no path")
        for name, frame, _ in frames:
            try:
                remarks = self.tree.check_motions(rig.world, [frame], limits)
            except TransformError as error:
                raise self._error(f"{name}: {error}") from None
            for remark in remarks:
                self._warnings.warn(remark)
        for name, frame, times in frames:
            self._require_known(name, frame, times)

    def _require_known(self, name: str, frame: str, times: IntArray) -> None:
        world, gap = self._rig.world, self._rig.clock.gap
        try:
            known = self.tree.lookups(world, frame, times, gap_s=gap)[1]
            if not known.any():
                self.tree.lookup(world, frame, int(times[len(times) // 2]), gap_s=gap)
        except TransformError as error:
            raise self._error(f"{name}: {error}") from None
        lost = int((~known).sum())
        if lost <= _MOST_LOST * len(times):
            return
        once = " and ".join(self.tree.sent_once(world, frame))
        reason = f"{once} was sent once, which counts for {gap:g} s; accepted: on tf_static"
        if not once:
            try:
                self.tree.lookup(world, frame, int(times[~known][0]), gap_s=gap)
            except TransformError as error:
                reason = str(error)
        self._warnings.warn(
            f"{name}: {lost} of {len(times)} poses of {frame} are not known, and left out: {reason}"
        )

    def _camera(self, sensor: ImageRig) -> PinholeCamera:
        """The intrinsics of a sensor, which fit its images."""
        info = self._infos.get(sensor.info)
        if info is None:
            raise self._error(f"no camera info of {sensor.name} on {sensor.info}", sensor.info)
        images = [values for _, values in self._sensed[sensor.depth].images]
        height, width = images[0].shape
        rectified = sensor.rectified
        if rectified is None:
            rectified = RECTIFIED.search(sensor.depth) is not None
        camera = info.rectified if rectified and info.rectified is not None else info.camera
        if (info.camera.height, info.camera.width) != (height, width):
            raise self._error(
                f"images of {sensor.name} have {width} x {height} pixels, and its camera info says "
                f"{info.camera.width} x {info.camera.height}; accepted: the same"
            )
        if info.distorted and not rectified:
            self._warnings.warn(
                f"{sensor.name}: its camera info names a distortion, which is not undone"
            )
        if sensor.rectified is None and not rectified and _differ(info):
            self._warnings.warn(
                f"{sensor.name}: K and P of its camera info differ, and topic {sensor.depth} does "
                "not say that its images are rectified: K is used; with rectified: true in the "
                "rig, P is"
            )
        for warning in camera.check_centre():
            self._warnings.warn(f"{sensor.name}: {warning.text}")
        if not (isinstance(sensor, BubbleRig) and sensor.kind == "deformation"):
            _check_unit(sensor, images)
        return camera

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
        images, begin = self._sensed[pad.depth].images, self.windows[0].begin
        untouched = [values for received, values in images if self.clocks.time(received) < begin]
        if pad.reference is None and pad.kind == "depth" and not untouched:
            untouched = [values for _, values in images]
            self._warnings.warn(
                f"{pad.name}: no image before the first probe; its reference is made of the first "
                f"{len(untouched)} of the probe"
            )
        return membrane_reference(pad, untouched, self.cameras[pad.name], self._log.path.parent)

    def _error(self, text: str, topic: str | None = None) -> SessionError:
        """topic: of which to say what was wrong with its messages, or what they are."""
        if topic is not None:
            faults = [fault for fault in self._log.faults if fault.startswith(f"{topic}: ")]
            schema = f"its schema is {self._log.topics[topic]}"
            text += f" ({faults[0].removeprefix(f'{topic}: ') if faults else schema})"
        return SessionError(f"log {self._log.path}: {text}")


def _topics(log: RawLog, rig: Rig) -> set[str]:
    """The topics that a rig needs, of which the log has all; those of transforms besides."""
    if not (rig.cameras or rig.bubbles or rig.clouds or rig.hand):
        raise SettingError(
            f"rig {rig.name} has no sensor; accepted: at least one of cameras, bubbles, clouds, "
            "hand"
        )
    named: dict[str | None, str] = {}
    for sensor in rig.sensors:
        named[sensor.depth] = f"depth of {sensor.name}"
        named[sensor.info] = f"camera info of {sensor.name}"
    named |= {cloud.topic: "points" for cloud in rig.clouds}
    named |= {force.topic: "forces" for force in rig.forces}
    if rig.hand is not None:
        named |= {rig.hand.pose: "pose of the hand", rig.hand.joints: "joints of the hand"}
    if rig.probes is None:
        named[rig.markers] = "markers of probes"
    topics = {topic: user for topic, user in named.items() if topic}
    missing = [f"{topic} ({user})" for topic, user in topics.items() if topic not in log.topics]
    if missing:
        raise SessionError(
            f"log {log.path} lacks what rig {rig.name} names: {', '.join(missing)}; it has "
            f"{log.listing()}"
        )
    kinds = {name: schema.replace(".", "/") for name, schema in log.topics.items()}
    return {*topics, *(name for name, kind in kinds.items() if kind.split("/")[-1] in _TRANSFORMS)}


def _differ(info: CameraInfoMessage) -> bool:
    """Whether rectified images have other intrinsics, by more than half a pixel."""
    one, other = info.camera, info.rectified
    if other is None:
        return False
    numbers = ("fx", "fy", "cx", "cy")
    return any(abs(getattr(one, name) - getattr(other, name)) > 0.5 for name in numbers)


def _check_unit(rig: ImageRig, images: list[np.ndarray]) -> None:
    """Raise SessionError if there are depths in images (H, W), and next to none is within range."""
    depths = np.concatenate([metres(values, rig.unit).reshape(-1) for values in images])
    depths = depths[np.isfinite(depths) & (depths > 0.0)]
    nearest, furthest = rig.range
    within = valid_pixels(depths, nearest=nearest, furthest=furthest)
    if len(depths) and within.mean() < _LEAST_WITHIN:
        unit = metres(np.ones(1, images[0].dtype), rig.unit)[0]
        raise SessionError(
            f"topic {rig.depth} of {rig.name} has depths of {np.median(depths):.4g} m (median, at "
            f"{unit:g} m a unit); accepted: from {nearest:g} to {furthest:g} m, its range: set "
            "unit, the metres of a unit of its images, or range"
        )
