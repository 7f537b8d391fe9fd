"""A depth camera that looks at the workspace: the rays of its pixels are free."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from chsel.errors import SessionError, SettingError
from chsel.events import SensorImage
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.poses import apply
from chsel.sensing.depth_camera import (
    PinholeCamera,
    depth_regions,
    occlusion_edges,
    speckle_free,
    valid_pixels,
)
from chsel.sensing.free_space import FreeGrid
from chsel.sensing.lens import LensDistortion
from runners.sensors.cell import RobotCell, is_entered
from runners.sensors.first_pass import FirstPass, SensorTopic
from runners.sensors.log.messages import CameraInfoMessage, ImageMessage
from runners.sensors.rig import CameraRig, GateRig, ImageRig
from runners.sensors.sensor import Sensed
from runners.sensors.session_report import Counts

INTEGER_UNIT = 0.001  # m: of 16-bit depth images, as all the world has it
FINE, COARSE = 0.0001, 0.001  # m: units of recorded images
_MANY_PIXELS = 50_000  # of an image: more are looked at in part
_EARLY = 0.95  # of the interval between two images: stamps are not exact
_LEAST_WITHIN = 0.01  # of the numbers, or else these are no depths in metres
_SHIFTED = 0.5  # pixels by which intrinsics differ
RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
"""Pattern of the names of topics of rectified images, by the convention of ROS."""

MISSED = (
    "its rays miss the workspace; check its frame, which must be the optical one (x right, z "
    "forward), its pose, and the workspace"
)


@dataclass(frozen=True, eq=False)
class View:
    """An image of metres (H, W) with its valid pixels (H, W), from world_from_camera (4, 4)."""

    metres: FloatArray
    valid: BoolArray
    camera: PinholeCamera
    world_from_camera: FloatArray


def view_of(
    message: ImageMessage,
    time: int,
    *,
    rig: ImageRig,
    camera: PinholeCamera,
    cell: RobotCell,
    counts: Counts,
    lens: LensDistortion | None = None,
) -> View | None:
    """Return an image at a time, nanoseconds, with its pose; None, counted, if it is unusable.

    lens: of depth images that it distorts, which is undone.
    """
    shape = (camera.height, camera.width)
    if message.values.shape != shape:
        cell.warnings.warn(
            f"{rig.name}: left out, as the image has another size than its camera info says"
        )
        counts.unusable += 1
        return None
    world_from_camera = cell.world_from(rig.frame or message.frame, time, sensor=rig.name)
    if world_from_camera is None:
        counts.lost += 1
        return None
    depth = metres(message.values, rig.unit)
    depth = depth if lens is None else lens.undistorted(depth, camera)
    valid = valid_pixels(depth, nearest=rig.range[0], furthest=rig.range[1])
    counts.pixels += valid.size
    counts.invalid += int(valid.size - valid.sum())
    return View(depth, valid, camera=camera, world_from_camera=world_from_camera)


def metres(values: np.ndarray, unit: float | None) -> FloatArray:
    """Return an image (H, W) in metres; unit: by default INTEGER_UNIT of integers, else 1."""
    if unit is None:
        unit = INTEGER_UNIT if np.issubdtype(values.dtype, np.integer) else 1.0
    return values.astype(np.float64) * unit


def recorded_image(
    step: int, sensor: str, *, kind: str, view: View, mask: BoolArray
) -> SensorImage:
    """Return an image with a mask (H, W) as recordings have it, 0 where it is not valid."""
    kept = np.where(view.valid, view.metres, 0.0)
    camera = view.camera
    unit = FINE if kept.max(initial=0.0) < 65535 * FINE else COARSE
    values = np.clip(np.rint(kept / unit), 0, 65535).astype(np.uint16)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return SensorImage(
        step=step,
        sensor=sensor,
        kind=kind,
        values=values,
        unit=unit,
        mask=mask,
        intrinsics=intrinsics,
        world_from_camera=view.world_from_camera,
    )


def edge_pixels(rig: CameraRig, view: View) -> BoolArray:
    """Return valid pixels (H, W) beside a jump of depth; none, if the rig asks for all."""
    if rig.edge is None:
        return np.zeros_like(view.valid)
    return occlusion_edges(view.metres, view.valid, jump=rig.edge, reach=rig.edge_reach)


def mark_rays(
    grid: FreeGrid, rig: CameraRig, *, gate: GateRig, view: View, usable: BoolArray
) -> tuple[int, int]:
    """Mark what the rays of usable pixels (H, W) pass.

    The rays of speckles end at the least depth of the valid pixels around them. Return how many
    voxels became free, and how many pixels are of speckles.
    """
    regions = depth_regions(view.metres, usable, camera=view.camera, jump=gate.jump)
    ends, small = speckle_free(view.metres, view.valid, regions=regions, least=gate.speckle)
    pose = view.world_from_camera
    return grid.from_depth(
        ends, view.camera, world_from_camera=pose, mask=usable, fraction=rig.fraction
    ), small


def some_rays(rig: CameraRig, view: View, *, usable: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return origin (3,) and ends (N, 3), world, of rays of some of the usable pixels (H, W)."""
    pose = view.world_from_camera
    some = slice(None, None, 1 + usable.size // _MANY_PIXELS)
    ends = rig.fraction * view.camera.back_project(view.metres)[some, some]
    return pose[:3, 3], apply(pose, ends[usable[some, some]])


def image_topics(rig: ImageRig) -> tuple[SensorTopic, SensorTopic]:
    """Return the topics of a sensor that sends depth images: images and intrinsics."""
    return (
        SensorTopic(rig.depth, ImageMessage, use=f"depth of {rig.name}"),
        SensorTopic(rig.info, CameraInfoMessage, use=f"camera info of {rig.name}"),
    )


def first_images(rig: ImageRig, first_pass: FirstPass) -> list[tuple[int, np.ndarray]]:
    """Return the first images (H, W) of a sensor, with their times, nanoseconds."""
    images = []
    for received in first_pass.first(image_topics(rig)[0]):
        assert isinstance(received.content, ImageMessage)
        images.append((first_pass.clocks.time(received), received.content.values))
    return images


def camera_of(rig: ImageRig, first_pass: FirstPass) -> tuple[PinholeCamera, LensDistortion | None]:
    """Return the intrinsics of a sensor, and the lens where its images are distorted by it.

    Raise SessionError unless they fit its images, or for a lens of another model.
    """
    of_info = image_topics(rig)[1]
    infos = first_pass.first(of_info)
    if not infos:
        raise first_pass.error(f"no camera info of {rig.name} on {rig.info}", of_info)
    info = infos[0].content
    assert isinstance(info, CameraInfoMessage)
    height, width = first_images(rig, first_pass)[0][1].shape
    rectified = rig.rectified
    if rectified is None:
        rectified = RECTIFIED.search(rig.depth) is not None
    camera = info.rectified if rectified and info.rectified is not None else info.camera
    if (info.camera.height, info.camera.width) != (height, width):
        raise first_pass.error(
            f"images of {rig.name} have {width} x {height} pixels, and its camera info says "
            f"{info.camera.width} x {info.camera.height}; accepted: the same"
        )
    lens = None
    if info.distortion and not rectified:
        try:
            lens = LensDistortion(info.distortion_model, info.distortion)
        except SettingError as error:
            text = f"camera info of {rig.name}: {error}, or rectified: true in the rig"
            raise first_pass.error(text, of_info) from None
    if rig.rectified is None and not rectified and _differ(info):
        first_pass.warnings.warn(
            f"{rig.name}: K and P of its camera info differ, and topic {rig.depth} does not say "
            "that its images are rectified: K is used; with rectified: true in the rig, P is"
        )
    for warning in camera.check_centre():
        first_pass.warnings.warn(f"{rig.name}: {warning.text}")
    return camera, lens


def _differ(info: CameraInfoMessage) -> bool:
    """Return whether rectified images have other intrinsics, by more than half a pixel."""
    one, other = info.camera, info.rectified
    if other is None:
        return False
    away = np.subtract([one.fx, one.fy, one.cx, one.cy], [other.fx, other.fy, other.cx, other.cy])
    return bool((np.abs(away) > _SHIFTED).any())


def check_unit(rig: ImageRig, first_pass: FirstPass) -> None:
    """Raise SessionError if the first images have depths, and next to none is within range."""
    images = [values for _, values in first_images(rig, first_pass)]
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


class DepthCamera:
    """A sensor that marks as free what it sees through (CHSEL, Sec. V-B: 95 % of the depth)."""

    _camera: PinholeCamera
    _lens: LensDistortion | None
    _cell: RobotCell

    def __init__(self, rig: CameraRig) -> None:
        self.name = rig.name
        self.topics = image_topics(rig)
        self.frame = rig.frame
        self._rig = rig
        self._views: FreeGrid | None = None  # by views, where several make a voxel free
        self._last_time: int | None = None
        self._reaches = False  # whether its rays reach the workspace
        self._last: tuple[View, BoolArray] | None = None

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Take the intrinsics. Raise SessionError unless they and depths fit the rig."""
        self._cell = cell
        self._camera, self._lens = camera_of(self._rig, first_pass)
        check_unit(self._rig, first_pass)
        if self._rig.views > 1:
            self._views = FreeGrid(cell.free.workspace, cell.spacing, views=self._rig.views)

    def take(self, time: int, message: ImageMessage, *, counts: Counts, within: bool) -> None:
        """Use an image of the current probe, unless it comes too soon after the last one."""
        counts.images += 1
        if self._too_soon(time):
            counts.spared += 1
            return
        view = view_of(
            message,
            time,
            rig=self._rig,
            camera=self._camera,
            cell=self._cell,
            counts=counts,
            lens=self._lens,
        )
        if view is None:
            return
        edges = edge_pixels(self._rig, view)
        counts.edges += int(edges.sum())
        usable = view.valid & ~edges
        if not usable.any():
            counts.unusable += 1
            self._cell.warnings.warn(f"{self._rig.name}: an image without a pixel that counts")
            return
        grid = self._cell.free.grid
        fresh, small = mark_rays(
            self._views or grid, self._rig, gate=self._cell.gate, view=view, usable=usable
        )
        counts.free += fresh if self._views is None else grid.at(self._views.new())
        counts.small += small
        counts.used += 1
        if not self._reaches:
            origin, ends = some_rays(self._rig, view, usable=usable)
            self._reaches = is_entered(self._cell.free.workspace, origin, ends=ends)
        self._last_time = time
        self._last = (view, usable)

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the last image of a probe, with the pixels whose rays are free."""
        if self._last is None:
            return Sensed()
        view, usable = self._last
        self._last = None
        return Sensed(image=recorded_image(step, self.name, kind="depth", view=view, mask=usable))

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that it gave; "" if nothing is."""
        if self._reaches or not total.used:
            return ""
        return f"{MISSED} (all of {total.used} images)"

    def _too_soon(self, time: int) -> bool:
        if self._rig.rate is None or self._last_time is None:
            return False
        return 0 <= time - self._last_time < _EARLY * 1e9 / self._rig.rate
