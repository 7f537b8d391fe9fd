"""The robot's sessions: the wrist pushes into the cabinet again and again, recorded in a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.streams import Purpose, StreamKey, normals
from replay.files import whole_file
from runners.sessions.configurations import Configuration
from runners.simulated_robot import wrist
from runners.simulated_robot.cabinet import REST, stood_on_shelf
from runners.simulated_robot.log_writer import LogWriter
from runners.simulated_robot.pads import Pads
from runners.simulated_robot.physics_scene import PhysicsScene
from runners.simulated_robot.recorder import TICK, Recorder
from runners.simulated_robot.settings import RobotSettings

HOME = (0.48, 0.0, 0.433)  # m: where the wrist is before and after all probes
REACTION = 1  # ticks that the robot still moves on when its pads have felt something
PAUSE = 5  # ticks between the steps of a push
_SECONDS = TICK / 1e9


@dataclass(frozen=True)
class Push:
    """A probe as it really was. y, z: of the wrist, metres. reach: metres that it went.

    stopped: by the "pads", the rigid "hand", or the "end" of its way. pressed: pixels of each pad
    beyond the threshold then.
    """

    step: int
    y: float
    z: float
    reach: float
    stopped: str
    pressed: dict[str, int]


@dataclass(frozen=True, eq=False)
class SimulatedLog:
    """What the log's readers are to find out. world_from_object (4, 4): of the mesh."""

    world_from_object: FloatArray
    pushes: tuple[Push, ...]
    seconds: float
    messages: int


def simulate_log(
    path: Path,
    configuration: Configuration,
    mesh: trimesh.Trimesh,
    seed: int,
    settings: RobotSettings,
    on_push: Callable[[Push], None] | None = None,
) -> SimulatedLog:
    """Probe an object in the cabinet, and write the raw log; an older file of that name is gone.

    mesh: in its own frame, metres, of real size. The same arguments give the same bytes. Raises
    SessionError if the object does not fit the cabinet, or where PyBullet is not installed.
    """
    grid = configuration.grid[: probe_count(configuration, settings)]
    world_from_object = stood_on_shelf(mesh, configuration)
    pushes = []
    with (
        closing(PhysicsScene(mesh, world_from_object)) as scene,
        whole_file(path) as beside,
        LogWriter(beside) as log,
    ):
        pads = Pads(scene, settings.bubbles.pinhole, mesh, world_from_object)
        robot = _Robot(scene, pads, Recorder(log, scene, pads, settings, seed), settings)
        robot.stand(settings.standing)
        for step, offset in enumerate(grid):
            pushes.append(robot.probe(step, offset, StreamKey(seed, step)))
            if on_push is not None:
                on_push(pushes[-1])
        robot.move(np.array(HOME), settings.move_speed)
        robot.stand(settings.dwell)
    return SimulatedLog(world_from_object, tuple(pushes), robot.seconds, log.messages)


def probe_count(configuration: Configuration, settings: RobotSettings) -> int:
    """How many probes there will be; SettingError for more than the configuration has."""
    most = len(configuration.grid)
    if settings.probes is not None and settings.probes > most:
        raise SettingError(f"probes is {settings.probes}; accepted: 1 to {most}, or null for all")
    return settings.probes or most


class _Robot:
    """Moves the wrist on straight lines, tick by tick."""

    def __init__(
        self, scene: PhysicsScene, pads: Pads, recorder: Recorder, settings: RobotSettings
    ) -> None:
        self._scene = scene
        self._pads = pads
        self._recorder = recorder
        self._settings = settings
        self._position = np.array(HOME)
        self._began = recorder.now

    @property
    def seconds(self) -> float:
        return (self._recorder.now - self._began) / 1e9

    def stand(self, seconds: float) -> None:
        """Wait, with all sensors on."""
        for _ in range(round(seconds / _SECONDS)):
            self._recorder.tick(self._position)

    def move(self, target: FloatArray, speed: float) -> None:
        """Go to target (3,), whatever is in the way."""
        for position in _line(self._position, target, speed):
            self._arrive(position)

    def probe(self, step: int, offset: tuple[float, float], key: StreamKey) -> Push:
        """Go before the object, push until something stops it, and come back."""
        settings, recorder = self._settings, self._recorder
        recorder.enter(step)
        spread = settings.spread * np.clip(normals(key.stream(Purpose.CONTROL_NOISE), 2), -3, 3)
        start = np.array(REST) + np.array([0.0, *(np.array(offset) + spread)])
        self.move(start, settings.move_speed)
        recorder.mark(f"begin {step}")
        stopped = self._push()
        self.stand(settings.dwell)
        recorder.mark(f"end {step}")
        reach = float(self._position[0] - start[0])
        pressed = self._pads.pressed(recorder.depths(self._position))
        self.move(start, settings.move_speed)
        return Push(step, float(start[1]), float(start[2]), reach, stopped, pressed)

    def _push(self) -> str:
        """Step forward until the hand is stopped; by what."""
        ahead = np.array([self._settings.push_step, 0.0, 0.0])
        for _ in range(self._settings.push_steps):
            way = _line(self._position, self._position + ahead, self._settings.push_speed)
            for position in way:
                self._arrive(position)
                stopped = self._stopped()
                if stopped == "hand":
                    return stopped
                if stopped:
                    for _, position in zip(range(REACTION), way, strict=False):
                        self._arrive(position)
                    return stopped
            for _ in range(PAUSE):
                self._recorder.tick(self._position)
        return "end"

    def _stopped(self) -> str:
        if self._scene.clearance(wrist.world_from_wrist(self._position)) <= 0.0:
            return "hand"
        depths = self._recorder.depths(self._position)
        return "pads" if self._pads.touches(depths) else ""

    def _arrive(self, position: FloatArray) -> None:
        self._position = position
        self._recorder.tick(position)


def _line(start: FloatArray, end: FloatArray, speed: float) -> Iterator[FloatArray]:
    """Where the wrist (3,) is at the ticks of its way; the last is its end."""
    way = end - start
    ticks = int(np.ceil(np.sqrt(way @ way) / (speed * _SECONDS) - 1e-9))
    for tick in range(1, ticks + 1):
        yield start + way * (tick / ticks)
