"""The simulated robot's streams: at every tick of its clock it sends what is due."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.streams import Purpose, StreamKey
from runners.simulated_robot import cabinet, log_writer, wrist
from runners.simulated_robot.log_writer import LogWriter
from runners.simulated_robot.noise import bubble_depth, stereo_depth
from runners.simulated_robot.pads import Pads
from runners.simulated_robot.physics_scene import PhysicsScene
from runners.simulated_robot.settings import RobotSettings

WORLD = "world"
WRIST = "wrist"
CAMERA = "camera_depth_optical_frame"
TICK = 20_000_000  # ns: transforms are sent at every one
START = 1_700_000_000_000_000_000  # ns: when every log begins
JOINTS = ("wrist_x", "wrist_y", "wrist_z")

# How long messages take to the log, seconds: at least, and that much more on average.
_QUICK = (0.0005, 0.001)
_SLOW = (0.020, 0.008)
_SECOND = 1_000_000_000  # ns


def bubble_frame(pad: str) -> str:
    """Name of the optical frame of a pad's camera."""
    return f"bubble_{pad}_camera"


class Recorder:
    """Writes the robot's streams. `tick` is one moment of the clock, the wrist at some place."""

    def __init__(
        self, log: LogWriter, scene: PhysicsScene, pads: Pads, settings: RobotSettings, seed: int
    ) -> None:
        self._log = log
        self._scene = scene
        self._pads = pads
        self._settings = settings
        self._seed = seed
        self._ticks = 0
        self._world_from_camera = cabinet.world_from_camera()
        self._seen: dict[str, tuple[bytes, Any]] = {}
        self.enter(0)
        self._send_static()

    @property
    def now(self) -> int:
        """The simulated time, nanoseconds."""
        return START + self._ticks * TICK

    def enter(self, probe: int) -> None:
        """From here on all noise is that of a probe."""
        self._key = StreamKey(self._seed, probe)
        self._latency = self._key.stream(Purpose.SENSOR_NOISE, 0)
        self._images = 0

    def mark(self, text: str) -> None:
        """Say that a probe begins or ends."""
        self._send("/probe", "std_msgs/String", {"data": text}, self.now)

    def tick(self, position: FloatArray) -> None:
        """Send what is due with the wrist at position (3,), and let the clock go on."""
        pose, now = wrist.world_from_wrist(position), self.now
        moved = log_writer.transform(WORLD, WRIST, pose, now)
        self._send("/tf", "tf2_msgs/TFMessage", {"transforms": [moved]}, now)
        joints = log_writer.joint_state(JOINTS, position.tolist(), now)
        self._send("/joint_states", "sensor_msgs/JointState", joints, now)
        if self._due(self._settings.bubbles.rate):
            self._send_bubbles(pose)
        if self._due(self._settings.camera.rate):
            self._send_camera(pose)
        self._ticks += 1
        self._log.flush(now)

    def depths(self, position: FloatArray) -> dict[str, FloatArray]:
        """What the bubbles' cameras see without noise; see `Pads.depths`."""
        pose = wrist.world_from_wrist(position)
        return self._once("bubbles", pose, lambda: self._pads.depths(pose))

    def _due(self, rate: float) -> bool:
        per_tick = rate * TICK / _SECOND
        return self._ticks == 0 or int(self._ticks * per_tick) > int((self._ticks - 1) * per_tick)

    def _send_static(self) -> None:
        now = self.now
        fixed = [log_writer.transform(WORLD, CAMERA, self._world_from_camera, now)]
        for pad in wrist.PADS:
            pose = wrist.wrist_from_bubble_camera(pad)
            fixed.append(log_writer.transform(WRIST, bubble_frame(pad), pose, now))
        self._send("/tf_static", "tf2_msgs/TFMessage", {"transforms": fixed}, now)

    def _send_bubbles(self, pose: FloatArray) -> None:
        bubbles = self._settings.bubbles
        depths = self._once("bubbles", pose, lambda: self._pads.depths(pose))
        for pad, depth in depths.items():
            noise, lost = self._image_stream()
            if lost:
                continue
            topic, frame = f"/bubble_{pad}/depth", bubble_frame(pad)
            values = bubble_depth(depth, bubbles, noise)
            sent = log_writer.image(frame, values, self.now)
            info = log_writer.camera_info(frame, bubbles.pinhole, self.now)
            self._send(f"{topic}/image_raw", "sensor_msgs/Image", sent, self.now, _SLOW)
            self._send(f"{topic}/camera_info", "sensor_msgs/CameraInfo", info, self.now)

    def _send_camera(self, pose: FloatArray) -> None:
        camera, pinhole = self._settings.camera, self._settings.camera.pinhole
        noise, lost = self._image_stream()
        if lost:
            return
        stamp = self.now + round(self._settings.clock_offset * _SECOND)
        depth = self._once(
            "camera", pose, lambda: self._scene.depth(pinhole, self._world_from_camera, pose)
        )
        values = stereo_depth(depth, pinhole, camera, noise)
        topic, info = "/camera/depth", log_writer.camera_info(CAMERA, pinhole, stamp)
        if self._settings.compressed:
            kind, sent = "CompressedImage", log_writer.compressed_image(CAMERA, values, stamp)
        else:
            kind, sent = "Image", log_writer.image(CAMERA, values, stamp)
        self._send(f"{topic}/image_raw", f"sensor_msgs/{kind}", sent, self.now, _SLOW)
        self._send(f"{topic}/camera_info", "sensor_msgs/CameraInfo", info, self.now)

    def _image_stream(self) -> tuple[np.random.Generator, bool]:
        """The noise of the next image of a probe, and whether it is lost on its way."""
        self._images += 1
        stream = self._key.stream(Purpose.SENSOR_NOISE, self._images)
        return stream, bool(stream.random() < self._settings.drop)

    def _once(self, what: str, pose: FloatArray, see: Callable[[], Any]) -> Any:
        """What is seen from here; a hand that stands still need not be looked at again."""
        place = pose.tobytes()
        if what not in self._seen or self._seen[what][0] != place:
            self._seen[what] = (place, see())
        return self._seen[what][1]

    def _send(
        self,
        topic: str,
        kind: str,
        message: Mapping[str, Any],
        sent: int,
        latency: tuple[float, float] = _QUICK,
    ) -> None:
        least, more = latency
        taken = least + 2.0 * more * self._latency.random()
        self._log.add(topic, kind, message, sent, sent + round(taken * _SECOND))
