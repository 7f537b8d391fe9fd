"""Whether a log has what its rig needs."""

from __future__ import annotations

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import IntArray
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.motion import Movements
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.transforms import TransformError
from runners.sensors.log_scan import LogScan, missing_images
from runners.sensors.rig import Rig
from runners.sensors.session_report import LogWarnings

_TRANSFORMS = ("TFMessage", "TransformStamped", "FrameTransform", "FrameTransforms")

_OWN_SCHEMAS = "chsel."


def require_topics(log: RawLog, rig: Rig) -> None:
    """Raise SessionError, which lists what the log has, unless it has the topics of the rig."""
    if any(topic.schema.startswith(_OWN_SCHEMAS) for topic in log.topics.values()):
        raise SessionError(
            f"log {log.path} is a recording of a session, not a robot's log; accepted: "
            f"session=recorded session.path={log.path}"
        )
    missing = {topic: user for topic, user in named_topics(rig).items() if topic not in log.topics}
    if missing:
        listed = ", ".join(f"{topic} ({user})" for topic, user in missing.items())
        raise SessionError(
            f"log {log.path} lacks what rig {rig.name} names: {listed}; it has {log.listing()}"
        )


def named_topics(rig: Rig) -> dict[str, str]:
    """All topics that a rig names, and what for."""
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
    if not (rig.cameras or rig.bubbles or rig.clouds or rig.hand):
        raise SettingError(
            f"rig {rig.name} has no sensor; accepted: at least one of cameras, bubbles, clouds, "
            "hand"
        )
    return named


def transform_topics(log: RawLog) -> list[str]:
    """The topics of a log that hold transforms, by their schemas."""
    return [
        name
        for name, topic in log.topics.items()
        if topic.schema.replace(".", "/").split("/")[-1] in _TRANSFORMS
    ]


class ScannedLog:
    """What a first pass gathered; raises SessionError for what no session can do without."""

    def __init__(
        self,
        log: RawLog,
        scan: LogScan,
        moving: Movements,
        clocks: ClockCorrection,
        warnings: LogWarnings,
    ) -> None:
        self.log, self.rig, self.scan, self.moving = log, scan.rig, scan, moving
        self.clocks, self.warnings = clocks, warnings
        self.times = {topic: times.times(clocks) for topic, times in scan.message_times.items()}
        """Of the messages by topic (N,), nanoseconds, ascending."""

    def check_sensors(self) -> None:
        """Messages of every sensor, units, and the poses of sensors and hand."""
        for sensor in self.rig.sensors:
            self._require_messages(sensor.depth, sensor.name, "depth images")
            self._require_poses(sensor.name, sensor.depth, sensor.frame)
            suspicious = self.scan.units[sensor.name].judge()
            if suspicious:
                self.warnings.warn(suspicious)
            lost = missing_images(self.times[sensor.depth])
            if lost:
                count = len(self.times[sensor.depth])
                self.warnings.note(
                    f"{sensor.name}: about {lost} of {count + lost} images are missing"
                )
        for cloud in self.rig.clouds:
            self._require_messages(cloud.topic, cloud.topic, "points")
            self._require_poses(cloud.topic, cloud.topic, None)
        for force in self.rig.forces:
            self._require_messages(force.topic, force.topic, "forces")
            self._require_poses(force.topic, force.topic, force.frame)
        if self.rig.hand is not None:
            self._require_hand(self.rig.hand.frame)

    def cameras(self) -> dict[str, PinholeCamera]:
        """Intrinsics by the names of sensors."""
        cameras = {}
        for sensor in self.rig.sensors:
            info = self.scan.infos.get(sensor.info)
            if info is None:
                raise SessionError(
                    f"log {self.log.path}: no camera info of {sensor.name} on topic "
                    f"{sensor.info}{self._reason(sensor.info)}"
                )
            sizes = self.scan.message_times[sensor.depth].sizes
            if (info.height, info.width) not in sizes:
                (height, width), _ = sizes.most_common(1)[0]
                raise SessionError(
                    f"log {self.log.path}: images of {sensor.name} have {width} x {height} "
                    f"pixels, and its camera info says {info.width} x {info.height}; accepted: "
                    "the same"
                )
            if info.distorted:
                self.warnings.warn(
                    f"{sensor.name}: its camera info names a distortion, which is not undone"
                )
            changes = self.scan.changed_infos.get(sensor.info, 0)
            if changes:
                self.warnings.warn(f"{sensor.name}: another camera info than the first", changes)
            cameras[sensor.name] = PinholeCamera(
                info.width, info.height, info.fx, info.fy, info.cx, info.cy
            )
        return cameras

    def _require_messages(self, topic: str, sensor: str, what: str) -> None:
        if not len(self.times[topic]):
            raise SessionError(
                f"log {self.log.path}: topic {topic} of {sensor} gives no {what}"
                f"{self._reason(topic)}"
            )

    def _reason(self, topic: str) -> str:
        """What was wrong with the messages of a topic, or what they are."""
        for fault in self.log.faults:
            if fault.startswith(f"{topic}: "):
                return f" ({fault.removeprefix(f'{topic}: ')})"
        return f" (its schema is {self.log.topics[topic].schema})"

    def _require_poses(self, name: str, topic: str, frame: str | None) -> None:
        frame = frame or self.scan.message_times[topic].frame
        if not frame:
            raise SessionError(
                f"log {self.log.path}: messages on {topic} of {name} name no frame; accepted: the "
                "frame of a transform, in the messages or as frame in the rig"
            )
        self._require_known(name, frame, self.times[topic])

    def _require_hand(self, frame: str) -> None:
        times = self.moving.times()
        if len(times):
            self._require_known("hand", frame, times)
        else:
            self.warnings.warn("no transform of the log ever changes: the hand has no path")

    def _require_known(self, name: str, frame: str, times: IntArray) -> None:
        """Raise SessionError unless a frame's pose is known at one of the times at least."""
        tree, world, gap = self.moving.tree, self.rig.world, self.rig.clock.gap
        try:
            known = tree.lookups(world, frame, times, gap_s=gap)[1]
            if not known.any():
                tree.lookup(world, frame, int(times[len(times) // 2]), gap_s=gap)
        except TransformError as error:
            raise SessionError(f"log {self.log.path}: {name}: {error}") from None
