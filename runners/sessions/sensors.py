"""Sources whose known points come from a robot's log, or from one depth image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from chsel.errors import SessionError, SettingError
from chsel.events import Logged, Probe, RigDescribed, Start
from chsel.numerics.arrays import FloatArray, digest
from chsel.problem.points import KnownPoints, check_points
from chsel.problem.pose_prior import PosePrior, prior_from_settings
from chsel.problem.settings import CheckedSettings, not_negative, positive
from replay.files import file_digest
from runners.objects.loader import ObjectModel
from runners.sensors.cell import FreeMap, RobotCell, is_entered
from runners.sensors.depth_camera import (
    MISSED,
    View,
    recorded_image,
    some_rays,
)
from runners.sensors.depth_frame import SUFFIXES as FRAME_SUFFIXES
from runners.sensors.depth_frame import DepthFrame, depth_frame_points, read_depth_frame
from runners.sensors.first_pass import FirstPass
from runners.sensors.hand import HandModel, HandPath
from runners.sensors.log.clocks import in_time_order
from runners.sensors.log.lerobot import INFO, LeRobotEpisode
from runners.sensors.log.messages import Received
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.trajectory_files import trajectory_files
from runners.sensors.pose_file import beside, read_pose
from runners.sensors.registry import sensors_of
from runners.sensors.rig import Rig
from runners.sensors.second_pass import SecondPass
from runners.sensors.session_report import LogWarnings, Report
from runners.sessions.probing import box_shell
from runners.sessions.source import ObjectOrigin, ProbeEvent, ProbeSource, SourceKind

NO_POSE = "none"
_FAR = 10.0  # m: from the world's origin, of no camera or object on or beside a table
_MANY_EDGES = 0.4  # of a camera's pixels: rather a slanted surface, seen in few pixels
_MANY_OF_LABEL = 0.2  # of its pixels left out: rather a wrong label


@dataclass(frozen=True)
class SensorsSettings(CheckedSettings):
    """A log of sensors, and what its topics are."""

    rig: Rig
    path: str | None = None  # .mcap, .db3, .bag, a folder of these, or a depth image's YAML
    pose: str | None = None
    """File of the true pose; None: that beside the log, if there is one; "none": unknown."""
    free_resolution: Annotated[float, positive] = 0.01  # side of a free voxel, m
    object_resolution: Annotated[float, positive] | None = None
    """Spacing of the object's SDF grid, m; None: by the object, see `ObjectModel.resolution`."""
    object_padding: Annotated[float, positive] = 0.05  # of the object's SDF grid, m
    start_contacts: Annotated[int, not_negative] = 4  # a registration needs so many contacts
    start_probe: Annotated[int, not_negative] = 0  # and this index of the probe
    images: bool = True  # record the images, too
    prior: Annotated[Any, prior_from_settings] = None
    """Fields of `chsel.PosePrior`; None: as the rig says."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            raise SettingError(
                "path is missing; pass session.path=LOG, an .mcap, .db3 or .bag file, a folder of "
                "these, or the .yaml of a depth image"
            )

    @property
    def pose_prior(self) -> PosePrior | None:
        """Prior on the pose of the object; None: nothing is known of it."""
        given = self.rig.prior if self.prior is None else self.prior
        return prior_from_settings("session.prior", given)


def open_sensors(  # noqa: PLR0917
    settings: SensorsSettings, object_model: ObjectModel | None, seed: int
) -> ProbeSource:
    """Open the source of a log, or of a depth image. Raise SessionError if it cannot be used."""
    assert object_model is not None
    if Path(settings.path or "").suffix.lower() in FRAME_SUFFIXES:
        frame = read_depth_frame(settings.path or "")
        return DepthFrameSource(settings, object_model, frame=frame)
    return SensorsSource(settings, seed, diameter=object_model.diameter)


SENSORS = SourceKind(
    SensorsSettings,
    open_sensors,
    object=ObjectOrigin.REAL,
    groups=({"presets/rig@rig": "default"}, {"rig": "cabinet"}),
)


def _opened(path: Path, rig: Rig) -> RawLog | LeRobotEpisode:
    """Return a log, or an episode of a dataset. Raise SessionError if it cannot be used."""
    if (path / INFO).is_file():
        return LeRobotEpisode(path, rig.columns, episode=rig.episode)
    if rig.columns:
        raise SessionError(
            f"log {path} is no LeRobot dataset, of which rig {rig.name} names columns; accepted: a "
            f"folder with {INFO}, or a rig without columns"
        )
    return RawLog(path)


class SensorsSource(ProbeSource):
    """Reads a log twice: what is small at once, images one after the other; see `ProbeSource`."""

    def __init__(
        self, settings: SensorsSettings, seed: int, *, diameter: float | None = None
    ) -> None:
        """Open a log.

        seed: of the choice of contact pixels. diameter: of the object, metres, where known.

        Raise SessionError for a log without use.
        """
        path = Path(settings.path or "").expanduser()
        rig = settings.rig
        self.report: Report = Report()
        self.workspace = rig.box()
        self.free_resolution = settings.free_resolution
        self.start = Start(contacts=settings.start_contacts, step=settings.start_probe)
        self.prior = settings.pose_prior
        self.world_from_object: FloatArray | None = None
        self._rig = rig
        self._diameter = diameter
        self._lines = LogWarnings()
        hand = HandModel(rig.hand) if rig.hand else None
        for text in hand.warnings if hand else ():
            self._lines.warn(text)
        self._log = _opened(path, rig)
        self._find_pose(path, settings.pose)
        sensors = sensors_of(rig, hand)
        self._first_pass = FirstPass(
            self._log, rig, sensors=sensors, hand=hand, warnings=self._lines
        )
        free = FreeMap(self.workspace, self.free_resolution)
        cell = RobotCell(
            rig.world,
            self._first_pass.tree,
            gap=rig.clock.gap,
            free=free,
            warnings=self._lines,
            gate=rig.gate,
            diameter=diameter,
        )
        for sensor in sensors:
            sensor.prepare(self._first_pass, cell)
        self._first_pass.release()
        path_of_hand = None
        self._solids = None
        if rig.hand is not None and hand is not None:
            joints = self._first_pass.joints
            path_of_hand = HandPath(rig.hand, hand, joints=joints, times=cell.tree.times, cell=cell)
            self._solids = hand.solids(joints.first())
            missing = [name for name in hand.joint_names if name not in joints.first()]
            if missing:
                self._lines.warn(f"joints without a value are at 0: {', '.join(missing)}")
        self._second_pass = SecondPass(
            rig,
            sensors,
            hand=path_of_hand,
            cell=cell,
            report=self.report,
            seed=seed,
            images=settings.images,
        )
        beside_log = trajectory_files(rig.trajectories, self._first_pass.folder)
        self._digest = self._log.digest()
        if beside_log:
            digests = [self._digest, *(file_digest(file) for file in beside_log)]
            self._digest = digest(np.frombuffer("".join(digests).encode(), dtype=np.uint8))
        self.count = len(self._first_pass.windows)
        if rig.boundary == "box_shell":
            free.grid.at(box_shell(free.grid.lattice, self.workspace))
        self.initial_points = KnownPoints(free=free.new())
        annotated = {*rig.annotations.exclude, *(add.probe for add in rig.annotations.contacts)}
        for step in sorted(annotated - {window.step for window in self._first_pass.windows}):
            self._lines.warn(f"the rig annotates probe {step}, which the log does not have")

    def probes(self) -> Iterator[ProbeEvent]:
        """Yield the probes of the log, in their order, once; measurements are read as they go."""
        first_pass = self._first_pass
        yield RigDescribed(-1, self._rig.name, source=self._digest, hand=self._solids)
        messages: Iterator[Received] = iter(())
        if first_pass.measured():
            messages = self._log.messages(first_pass.measured())
        timed = in_time_order(messages, first_pass.clocks.time)
        yield from self._second_pass.events(first_pass.windows, timed)
        self._second_pass.check()
        for text, count in self._log.faults.items():
            self._lines.warn(text, count)
        for name, counts in self.report.total().items():
            if left_out := counts.left_out():
                self._lines.note(f"{name}: {left_out}")
            if counts.edges > _MANY_EDGES * counts.pixels:
                share = 100 * counts.edges // counts.pixels
                self._lines.warn(
                    f"{name}: {share} % of its pixels are left out as "
                    "edges; a larger edge (m), or a smaller edge_reach (pixels), keeps more"
                )
        self.report.lines = self._lines.lines()
        last = first_pass.windows[-1].step
        yield from (Logged(last, level, text=text) for level, text in self.report.lines)

    def close(self) -> None:
        """Release nothing, as nothing is held open."""

    def _find_pose(self, path: Path, chosen: str | None) -> None:
        """Read the true pose, if there is a file of it."""
        if chosen == NO_POSE:
            return
        file = Path(chosen).expanduser() if chosen else beside(path)
        if chosen or file.is_file():
            self.world_from_object = read_pose(file)
            position = self.world_from_object[:3, 3]
            lower, upper = self.workspace.bounds
            beyond = np.maximum(np.maximum(lower - position, position - upper), 0.0)
            away = float(np.sqrt((beyond**2).sum()))
            if away > (self._diameter or _FAR):
                self._lines.warn(
                    f"the true pose of {file.name} is {away:.3g} m outside of the workspace; check "
                    f"its unit, which is metres, and its frame, which is {self._rig.world}"
                )
            self._lines.note(f"the true pose is that of {file.name}")


class DepthFrameSource(ProbeSource):
    """The known points of a depth image as a single probe; see `ProbeSource`."""

    def __init__(
        self, settings: SensorsSettings, object_model: ObjectModel, *, frame: DepthFrame
    ) -> None:
        """frame: of the file at the path of the settings."""
        self.report: Report = Report()
        self.free_resolution = settings.free_resolution
        self.initial_points = KnownPoints()
        self.count = 1
        self.start = Start(contacts=settings.start_contacts, step=settings.start_probe)
        self.prior = settings.pose_prior
        self._rig = settings.rig
        self._path = Path(settings.path or "").expanduser()
        self._images = settings.images
        self._frame = frame
        self._points = depth_frame_points(
            self._frame,
            self._rig,
            free_resolution=self.free_resolution,
            diameter=object_model.diameter,
        )
        self.workspace = self._points.workspace
        self.world_from_object = self._frame.world_from_object
        check_points(
            self._points.points,
            object_model.diameter,
            free_resolution=self.free_resolution,
            workspace=self.workspace,
        )

    def probes(self) -> Iterator[ProbeEvent]:
        """Yield the image, and the probe that follows from it."""
        found, (camera,) = self._points, self._rig.cameras
        self.report.by_probe[0] = {camera.name: found.counts}
        yield RigDescribed(-1, self._rig.name, source=file_digest(self._path))
        if self._images:
            frame = self._frame
            measured = np.isfinite(frame.depth) & (frame.depth > 0.0)
            view = View(
                frame.depth,
                measured,
                camera=frame.camera,
                world_from_camera=frame.world_from_camera,
            )
            yield recorded_image(0, camera.name, kind="depth", view=view, mask=found.rays)
        count = len(found.points.known)
        text = f"{count} points on the object's surface, {len(found.points.free)} free voxels"
        yield Logged(0, "info", text=text)
        self.report.lines = list(self._remarks(camera.name))
        yield from (Logged(0, level, text=text) for level, text in self.report.lines)
        yield Probe(0, "points", new_points=found.points)

    def _remarks(self, name: str) -> Iterator[tuple[str, str]]:
        """Yield levels and texts on what was left out, and on what is suspicious."""
        found, label = self._points, self._points.labelled
        for warning in self._frame.camera.check_centre():
            yield "warning", f"{name}: {warning.text}"
        frame = self._frame
        poses = {"world_from_camera": frame.world_from_camera}
        if self.world_from_object is not None:
            poses["world_from_object"] = self.world_from_object
        for key, pose in poses.items():
            away = float(np.sqrt((pose[:3, 3] ** 2).sum()))
            if away > _FAR:
                text = f"{key} is {away:.4g} m from the origin; check its unit, which is metres"
                yield "warning", text
        view = View(
            frame.depth, found.rays, camera=frame.camera, world_from_camera=frame.world_from_camera
        )
        origin, ends = some_rays(self._rig.cameras[0], view, usable=found.rays)
        if found.rays.any() and not is_entered(self.workspace, origin, ends=ends):
            yield "warning", f"{name}: {MISSED}"
        for sensor, counts in ((name, found.counts), ("label", label)):
            if counts is not None and (left_out := counts.left_out()):
                yield "info", f"{sensor}: {left_out}"
        if label is not None and label.small + label.far > _MANY_OF_LABEL * label.pixels:
            share = 100 * (label.small + label.far) // label.pixels
            yield (
                "warning",
                f"{share} % of the label's pixels are left out, as they are not connected with the "
                "largest region; check label, object_class and gate.jump",
            )
        lower, upper = self.workspace.bounds
        known = found.points.known
        outside = ((known < lower) | (known > upper)).any(axis=1).sum()
        if outside:
            yield "warning", f"{outside} of {len(known)} surface points are out of the workspace"

    def close(self) -> None:
        """Release nothing, as nothing is held open."""
