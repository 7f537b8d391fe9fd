"""The robot's sessions: the wrist pushes into the cabinet repeatedly, recorded in a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.sensing.depth_camera import PinholeCamera
from replay.files import whole_file
from runners.sessions.configurations import Configuration
from runners.sessions.physics_engine import default_engine
from runners.simulated_robot import log_writer
from runners.simulated_robot.cabinet import (
    PADS,
    REST,
    stood_on_shelf,
    world_from_camera,
    world_from_wrist,
    wrist_from_bubble_camera,
)
from runners.simulated_robot.log_writer import LogWriter
from runners.simulated_robot.noise import bubble_depth, stereo_depth
from runners.simulated_robot.pads import Pads
from runners.simulated_robot.scene import Scene
from runners.simulated_robot.settings import RobotSettings

WORLD = "world"
WRIST = "wrist"
CAMERA = "camera_depth_optical_frame"
JOINTS = ("wrist_x", "wrist_y", "wrist_z")
TICK = 20_000_000  # ns: transforms are sent at every one
START = 1_700_000_000_000_000_000  # ns: when every log begins

HOME = (0.48, 0.0, 0.433)  # m: where the wrist is before and after all probes
PUSH_STEP = 0.05  # m
PUSH_SPEED, MOVE_SPEED = 0.05, 0.15  # m/s
SPREAD = 0.003  # m: standard deviation of the wrist's place in a probe
REACTION = 1  # ticks that the robot still moves on when its pads are pressed
PAUSE = 5  # ticks between the steps of a push

# How long messages take to the log, seconds: at least, and that much more on average.
_QUICK = (0.0005, 0.001)
_SLOW = (0.020, 0.008)
_SECOND = 1_000_000_000  # ns
_SECONDS = TICK / 1e9  # of a tick


@dataclass(frozen=True)
class Push:
    """A probe as it really was."""

    step: int  # index of the probe
    y: float  # of the wrist, metres
    z: float  # of the wrist, metres
    reach: float  # metres that the wrist went
    stopped: str  # by the "pads", the rigid "hand", or the "end" of its way


@dataclass(frozen=True, eq=False)
class SimulatedLog:
    """The truth about a log."""

    world_from_object: FloatArray
    """True pose (4, 4) of the mesh."""

    pushes: tuple[Push, ...]
    """Probes in their order."""


def simulate_log(
    path: Path,
    configuration: Configuration,
    *,
    mesh: trimesh.Trimesh,
    seed: int,
    settings: RobotSettings,
    on_push: Callable[[Push], None] = lambda push: None,
) -> SimulatedLog:
    """Probe an object in the cabinet, and write the raw log; an older file of that name is gone.

    mesh: in its own frame, metres, of real size. The same arguments give the same bytes. Raises
    SessionError if the object does not fit the cabinet, or where the engine is not installed.
    """
    most = len(configuration.grid)
    if settings.probes is not None and settings.probes > most:
        raise SettingError(f"probes is {settings.probes}; accepted: 1 to {most}, or null for all")
    world_from_object = stood_on_shelf(mesh, configuration)
    pushes = []
    with (
        closing(open_scene(mesh, world_from_object, engine=settings.engine)) as scene,
        whole_file(path, "a file in a folder that can be written") as beside,
        LogWriter(beside) as log,
    ):
        pads = Pads(scene, settings.bubbles.pinhole, mesh=mesh, world_from_object=world_from_object)
        robot = _Robot(log, scene, pads=pads, settings=settings, seed=seed)
        robot.stand(settings.standing)
        for step, offset in enumerate(configuration.grid[: settings.probes]):
            pushes.append(robot.probe(step, offset))
            on_push(pushes[-1])
        robot.move(np.array(HOME))
        robot.stand(settings.dwell)
    return SimulatedLog(world_from_object, tuple(pushes))


def open_scene(
    mesh: trimesh.Trimesh, world_from_object: FloatArray, *, engine: str | None = None
) -> Scene:
    """Open the scene of a mesh in its frame, metres, in the engine of this name, or the default.

    Raise SessionError where it is not installed.
    """
    if (engine or default_engine()) == "mujoco":
        from runners.simulated_robot.mujoco_scene import MuJoCoScene

        return MuJoCoScene(mesh, world_from_object)
    from runners.simulated_robot.pybullet_scene import PyBulletScene

    return PyBulletScene(mesh, world_from_object)


class _Robot:
    """Moves the wrist on straight lines, and sends at every tick of its clock what is due."""

    def __init__(
        self, log: LogWriter, scene: Scene, *, pads: Pads, settings: RobotSettings, seed: int
    ) -> None:
        self._log = log
        self._scene = scene
        self._pads = pads
        self._settings, self._seed = settings, seed
        self._ticks = 0
        self._place(np.array(HOME))
        self._world_from_camera = world_from_camera()
        self._enter(0)
        fixed = [(WORLD, CAMERA, self._world_from_camera)]
        fixed += [(WRIST, f"bubble_{pad}_camera", wrist_from_bubble_camera(pad)) for pad in PADS]
        sent = [
            log_writer.transform(parent, child, parent_from_child=pose, stamp=self._now)
            for parent, child, pose in fixed
        ]
        self._send("/tf_static", "tf2_msgs/TFMessage", message={"transforms": sent})

    def stand(self, seconds: float) -> None:
        """Wait, with all sensors on."""
        for _ in range(round(seconds / _SECONDS)):
            self._arrive(self._position)

    def move(self, target: FloatArray) -> None:
        """Go to target (3,), whatever is in the way."""
        for position in _line(self._position, target, speed=MOVE_SPEED):
            self._arrive(position)

    def probe(self, step: int, offset: tuple[float, float]) -> Push:
        """Go before the object, push until something stops it, and come back."""
        self._enter(step)
        drawn = normals(self._key.stream(Purpose.CONTROL_NOISE), 2)
        start = np.array(REST)
        start[1:] += np.array(offset) + SPREAD * np.clip(drawn, -3, 3)
        self.move(start)
        self._send("/probe", "std_msgs/String", message={"data": f"begin {step}"})
        stopped = self._push()
        self.stand(self._settings.dwell)
        self._send("/probe", "std_msgs/String", message={"data": f"end {step}"})
        reach = float(self._position[0] - start[0])
        self.move(start)
        return Push(step, float(start[1]), z=float(start[2]), reach=reach, stopped=stopped)

    def _push(self) -> str:
        """Step forward until the hand is stopped; by what."""
        ahead = np.array([PUSH_STEP, 0.0, 0.0])
        for _ in range(self._settings.push_steps):
            way = _line(self._position, self._position + ahead, speed=PUSH_SPEED)
            for position in way:
                self._arrive(position)
                if self._scene.is_blocked(self._pose):
                    return "hand"
                if self._pads.touches(self._depths):
                    for _, position in zip(range(REACTION), way, strict=False):
                        self._arrive(position)
                    return "pads"
            for _ in range(PAUSE):
                self._arrive(self._position)
        return "end"

    @property
    def _now(self) -> int:
        """The simulated time, nanoseconds."""
        return START + self._ticks * TICK

    def _enter(self, probe: int) -> None:
        """Take all noise from now on from the streams of a probe."""
        self._key = StreamKey(self._seed, probe)
        self._latency = self._key.stream(Purpose.SENSOR_NOISE, 0)
        self._images = 0

    def _place(self, position: FloatArray) -> None:
        """Put the wrist at position (3,), where the bubbles' cameras see depths without noise."""
        self._position = position
        self._pose = world_from_wrist(position)
        self._depths = self._pads.depths(self._pose)

    def _arrive(self, position: FloatArray) -> None:
        """Send what is due with the wrist at position (3,), and let the clock go on."""
        if not np.array_equal(position, self._position):
            self._place(position)
        now = self._now
        moved = log_writer.transform(WORLD, WRIST, parent_from_child=self._pose, stamp=now)
        self._send("/tf", "tf2_msgs/TFMessage", message={"transforms": [moved]})
        joints = log_writer.joint_state(JOINTS, position.tolist(), stamp=now)
        self._send("/joint_states", "sensor_msgs/JointState", message=joints)
        bubbles, camera = self._settings.bubbles, self._settings.camera
        if self._due(bubbles.rate):
            for pad, depth in self._depths.items():
                topic, frame = f"/bubble_{pad}/depth", f"bubble_{pad}_camera"
                self._send_image(
                    topic, frame, camera=bubbles.pinhole, measure=partial(bubble_depth, depth)
                )
        if self._due(camera.rate):
            depth = self._scene.depth(
                camera.pinhole, self._world_from_camera, world_from_wrist=self._pose
            )
            measure = partial(stereo_depth, depth, camera.pinhole)
            self._send_image("/camera/depth", CAMERA, camera=camera.pinhole, measure=measure)
        self._ticks += 1
        self._log.flush(now)

    def _due(self, rate: float) -> bool:
        per_tick = rate * TICK / _SECOND
        return self._ticks == 0 or int(self._ticks * per_tick) > int((self._ticks - 1) * per_tick)

    def _send_image(
        self,
        topic: str,
        frame: str,
        *,
        camera: PinholeCamera,
        measure: Callable[[np.random.Generator], np.ndarray],
    ) -> None:
        """Send an image, unless it is lost; measure: makes it with the noise of a stream."""
        self._images += 1
        stream = self._key.stream(Purpose.SENSOR_NOISE, self._images)
        if stream.random() >= self._settings.drop:
            sent = log_writer.image(frame, measure(stream), stamp=self._now)
            info = log_writer.camera_info(frame, camera, stamp=self._now)
            self._send(f"{topic}/image_raw", "sensor_msgs/Image", message=sent, latency=_SLOW)
            self._send(f"{topic}/camera_info", "sensor_msgs/CameraInfo", message=info)

    def _send(
        self,
        topic: str,
        kind: str,
        *,
        message: Mapping[str, Any],
        latency: tuple[float, float] = _QUICK,
    ) -> None:
        least, more = latency
        taken = least + 2.0 * more * self._latency.random()
        self._log.add(
            topic,
            kind,
            message=message,
            stamp=self._now,
            log_time=self._now + round(taken * _SECOND),
        )


def _line(start: FloatArray, end: FloatArray, *, speed: float) -> Iterator[FloatArray]:
    """Yield the positions (3,) of the wrist at the ticks of its way; the last is its end."""
    way = end - start
    ticks = int(np.ceil(np.sqrt(way @ way) / (speed * _SECONDS) - 1e-9))
    for tick in range(1, ticks + 1):
        yield start + way * (tick / ticks)
