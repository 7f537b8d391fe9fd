"""A session whose known points come from what a robot's sensors wrote into a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from chsel.errors import SettingError, require_positive
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from replay.events import Logged, RigDescribed
from runners.objects.loader import ObjectModel
from runners.sensors.cell import FreeMap, RobotCell
from runners.sensors.depth_frame import SUFFIXES as FRAME_SUFFIXES
from runners.sensors.first_pass import FirstPass
from runners.sensors.hand import HandModel
from runners.sensors.log.clocks import in_time_order
from runners.sensors.log.messages import Received
from runners.sensors.log.raw_log import RawLog
from runners.sensors.pose_file import beside, read_pose
from runners.sensors.rig import Rig
from runners.sensors.second_pass import SecondPass
from runners.sensors.session_report import LogWarnings, Report
from runners.sessions.depth_frame_session import DepthFrameSession
from runners.sessions.free_space import box_shell
from runners.sessions.session import Progress, Session, SessionEvent, unwatched

NO_POSE = "none"
_MEGABYTE = 2**20
_MANY = 0.4  # of a camera's pixels at edges: rather a slanted surface, seen in few pixels


@dataclass(frozen=True)
class SensorsSettings:
    """path: of the log, an .mcap file or a rosbag2 folder, or of a depth image's YAML.

    rig: what the log's topics are. pose: file of the true pose, by default that beside the log if
    there is one; "none": unknown. free_resolution: side of a free voxel, metres.
    object_resolution, object_padding: of the SDF grid, metres. start_contacts, start_probe: a
    registration needs so many contacts and this probe index. images: record the images, too.
    """

    rig: Rig
    path: str | None = None
    pose: str | None = None
    free_resolution: float = 0.01
    object_resolution: float = 0.005
    object_padding: float = 0.05
    start_contacts: int = 4
    start_probe: int = 0
    images: bool = True

    def __post_init__(self) -> None:
        if not self.path:
            raise SettingError(
                "path is missing; pass session.path=LOG, an .mcap file, a rosbag2 folder, or the "
                ".yaml of a depth image"
            )
        for name in ("free_resolution", "object_resolution", "object_padding"):
            require_positive(name, getattr(self, name))
        for name in ("start_contacts", "start_probe"):
            require_positive(name, getattr(self, name), zero=True)


def open_sensors(
    settings: SensorsSettings, object_model: ObjectModel, seed: int, progress: Progress = unwatched
) -> Session:
    """The session of a log, or of a depth image. Raises SessionError if it cannot be used."""
    path = Path(settings.path or "").expanduser()
    if path.suffix.lower() in FRAME_SUFFIXES:
        return DepthFrameSession(
            path,
            settings.rig,
            object_model,
            free_resolution=settings.free_resolution,
            images=settings.images,
        )
    return SensorsSession(settings, seed, progress, diameter=object_model.diameter)


class SensorsSession:
    """Reads a log twice: what is small at once, images one after the other; see `Session`."""

    def __init__(
        self,
        settings: SensorsSettings,
        seed: int,
        progress: Progress = unwatched,
        *,
        diameter: float | None = None,
    ) -> None:
        """seed: of the choice of contact pixels. diameter: of the object, metres, where known.

        Raises SessionError for a log without use.
        """
        path = Path(settings.path or "").expanduser()
        rig = settings.rig
        self.report = Report()
        self.workspace = rig.box()
        self.free_resolution = settings.free_resolution
        self.world_from_object: FloatArray | None = None
        self._rig, self._seed, self._images = rig, seed, settings.images
        self._progress, self._diameter = progress, diameter
        self._opening = LogWarnings()
        self._hand = HandModel(rig.hand) if rig.hand else None
        for text in self._hand.warnings if self._hand else ():
            self._opening.warn(text)
        self._log = RawLog(path, progress=self._shown("looking for topics"))
        self._find_pose(path, settings.pose)
        joints = self._hand.joint_names if self._hand else ()
        self._first_pass = FirstPass(
            self._log, rig, joints, self._opening, self._shown("first pass over the log")
        )
        missing = [name for name in joints if name not in self._first_pass.joints.first()]
        if missing:
            self._opening.warn(f"joints without a value are at 0: {', '.join(missing)}")
        self.source = self._log.digest()
        self.count = len(self._first_pass.windows)
        self.initial_points = KnownPoints(free=self._free_map()[1])
        annotated = {*rig.annotations.exclude, *(add.probe for add in rig.annotations.contacts)}
        for step in sorted(annotated - {window.step for window in self._first_pass.windows}):
            self._opening.warn(f"the rig annotates probe {step}, which the log does not have")

    def probes(self) -> Iterator[SessionEvent]:
        """The probes of the log, in their order; its images are read as they go."""
        rig, first_pass, warnings = self._rig, self._first_pass, LogWarnings(self._opening)
        self.report.by_probe.clear()
        cell = RobotCell(
            rig.world,
            first_pass.tree,
            rig.clock.gap,
            self._free_map()[0],
            warnings,
            rig.gate,
            self._diameter,
        )
        reading = SecondPass(
            rig, first_pass, cell, self.report, self._hand, seed=self._seed, images=self._images
        )
        hand = self._hand.solids(first_pass.joints.first()) if self._hand else None
        yield RigDescribed(-1, rig.name, self.source, hand)
        messages: Iterator[Received] = iter(())
        if first_pass.bulky:
            messages = self._log.messages(first_pass.bulky, progress=self._shown("reading images"))
        yield from reading.events(in_time_order(messages, first_pass.clocks.time))
        reading.check()
        for text, count in self._log.faults.items():
            warnings.warn(text, count)
        for name, counts in self.report.total().items():
            if left_out := counts.left_out():
                warnings.note(f"{name}: {left_out}")
            if counts.edges > _MANY * counts.pixels:
                share = 100 * counts.edges // counts.pixels
                warnings.warn(
                    f"{name}: {share} % of its pixels are left out as "
                    "edges; a larger edge (m), or a smaller edge_reach (pixels), keeps more"
                )
        self.report.lines = warnings.lines()
        last = first_pass.windows[-1].step
        yield from (Logged(last, level, text) for level, text in self.report.lines)

    def close(self) -> None:
        """Nothing is held open."""

    def _free_map(self) -> tuple[FreeMap, FloatArray]:
        """A map in which the workspace's border is free, and the centres (N, 3) of its voxels."""
        free = FreeMap(self.workspace, self.free_resolution)
        if self._rig.boundary == "box_shell":
            free.grid.at(box_shell(free.grid.lattice, self.workspace))
        return free, free.new()

    def _find_pose(self, path: Path, chosen: str | None) -> None:
        """The true pose, if there is a file of it."""
        if chosen == NO_POSE:
            return
        file = Path(chosen).expanduser() if chosen else beside(path)
        if chosen or file.is_file():
            self.world_from_object = read_pose(file)
            self._opening.note(f"the true pose is that of {file.name}")

    def _shown(self, stage: str) -> Callable[[int, int], None]:
        """Progress of a stage in bytes, shown in megabytes."""

        def show(done: int, total: int) -> None:
            self._progress(f"{stage}, MB", done // _MEGABYTE, -(-total // _MEGABYTE))

        return show
