"""One depth image as plain files, and its known points: free space, the object's surface."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from chsel.errors import ChselError, SessionError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply
from chsel.problem.settings import CheckedSettings, build_settings, not_negative, positive
from chsel.sensing.depth_camera import (
    PinholeCamera,
    depth_regions,
    main_regions,
    one_per_voxel,
    outside_of,
    valid_pixels,
)
from chsel.sensing.free_space import FreeGrid
from chsel.sensing.lens import LensDistortion
from runners.sensors.calibration_file import read_calibration
from runners.sensors.depth_camera import View, edge_pixels, mark_rays, metres
from runners.sensors.log.images import read_image
from runners.sensors.pose_file import pose_of_rows, read_yaml
from runners.sensors.rig import Rig
from runners.sensors.session_report import Counts

SUFFIXES = (".yaml", ".yml")
LABEL_MARGIN = 2  # pixels: by so much a label's outline may be off the depth image's
_MOST_LISTED = 20


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class FrameFile(CheckedSettings):
    """The keys of the YAML; paths in it are relative to it."""

    depth: str  # .png or .tiff of integers, .tiff or .npy of floating point
    intrinsics: Intrinsics | None = None
    calibration: str | None = None  # file of OpenCV or ROS, in place of intrinsics and distortion
    depth_scale: Annotated[float | None, positive] = None
    """Metres a unit; null: 0.001 for integers, 1 for floating point."""

    distortion: tuple[float, ...] = ()  # coefficients of the lens, in the order of OpenCV
    distortion_model: str = "plumb_bob"  # see `chsel.sensing.lens.LensDistortion`
    label: str | None = None  # image of classes
    object_class: Annotated[int | None, not_negative] = None  # the object's; null: all but 0
    object: str | None = None  # mesh of the object
    world_from_camera: tuple[Any, ...] | None = None  # (4, 4); null: the camera is the world
    world_from_object: tuple[Any, ...] | None = None  # (4, 4), the true pose
    factor_depth_in_file: Any = None  # this and the following keys are for people
    comment: Any = None
    licence: Any = None
    license: Any = None
    source: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.intrinsics is None) is (self.calibration is None):
            raise SessionError("accepted: intrinsics, or calibration, a file of OpenCV or ROS")
        if self.calibration is not None and self.distortion:
            raise SessionError("calibration and distortion; accepted: one of them")
        if self.object_class is not None and self.label is None:
            raise SessionError("object_class without label; accepted: both, or label alone")


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth image and what is known of it."""

    camera: PinholeCamera
    depth: FloatArray  # (H, W), metres along the axis; 0 or not finite: no measurement
    world_from_camera: FloatArray  # (4, 4), of the optical centre, x right, y down, z forward
    label: BoolArray | None = None  # (H, W), the pixels of the object, if it is labelled
    world_from_object: FloatArray | None = None  # (4, 4), the true pose, where known
    mesh: Path | None = None  # file of the object, where named


def read_depth_frame(path: str | Path) -> DepthFrame:
    """Return the frame that a YAML describes with the keys of `FrameFile`.

    Raise SessionError, which names the file and the key.
    """
    path = Path(path).expanduser()
    try:
        return _frame(build_settings(FrameFile, read_yaml(path), where="frame"), path.parent)
    except (ChselError, OverflowError) as error:  # an integer of many digits
        raise SessionError(f"depth frame {path}: {error}") from None


def _frame(file: FrameFile, folder: Path) -> DepthFrame:
    depth = _depth(file, folder)
    height, width = depth.shape
    lens = None
    if file.calibration is not None:
        path = folder / Path(file.calibration).expanduser()
        pinhole, lens = read_calibration(path, width=width, height=height)
    else:
        assert file.intrinsics is not None
        pinhole = PinholeCamera(width=width, height=height, **asdict(file.intrinsics))
        if any(file.distortion):
            lens = LensDistortion(file.distortion_model, file.distortion)
    label = None if file.label is None else _label(file, folder, shape=depth.shape)
    if lens is not None:
        depth = lens.undistorted(depth, pinhole)
        label = None if label is None else lens.undistorted_mask(label, pinhole)
    camera, truth = file.world_from_camera, file.world_from_object
    return DepthFrame(
        pinhole,
        depth,
        world_from_camera=np.eye(4)
        if camera is None
        else pose_of_rows("world_from_camera", camera),
        label=label,
        world_from_object=None if truth is None else pose_of_rows("world_from_object", truth),
        mesh=None if file.object is None else folder / Path(file.object).expanduser(),
    )


def _depth(file: FrameFile, folder: Path) -> FloatArray:
    """Return depths (H, W), metres."""
    path = folder / Path(file.depth).expanduser()
    stored = read_image(path, "depth")
    if stored.dtype == np.uint8:
        raise SessionError(f"depth {path}: 8 bits a pixel; accepted: 16, or floating point")
    with np.errstate(all="ignore"):
        depth = metres(stored, file.depth_scale)
    if not ((depth > 0.0) & np.isfinite(depth)).any():
        raise SessionError(f"depth {path}: no pixel has a measurement; accepted: values above 0")
    return depth


def _label(file: FrameFile, folder: Path, *, shape: tuple[int, ...]) -> BoolArray:
    """Return the object's pixels (H, W)."""
    path = folder / Path(file.label or "").expanduser()
    classes = read_image(path, "label")
    if classes.dtype.kind not in "ui" or classes.shape != shape:
        (height, width) = shape
        (rows, columns) = classes.shape
        raise SessionError(
            f"label {path}: {columns} x {rows} pixels of {classes.dtype}; accepted: whole numbers, "
            f"as many as of depth, {width} x {height}"
        )
    mask = classes != 0 if file.object_class is None else classes == file.object_class
    if not mask.any():
        present = ", ".join(map(str, np.unique(classes)[:_MOST_LISTED].tolist()))
        raise SessionError(f"object_class {file.object_class} is not in label; accepted: {present}")
    return mask


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Known points of a frame, and counts of its pixels that do not count."""

    points: KnownPoints  # free voxels' centres, and surface points; metres, world
    workspace: Workspace  # where the object can be
    rays: BoolArray  # (H, W), pixels whose rays are free
    surface: BoolArray  # (H, W), pixels on the object
    counts: Counts  # of the whole image
    labelled: Counts | None  # of the pixels of the object's label, if there is one


def depth_frame_points(
    frame: DepthFrame, rig: Rig, *, free_resolution: float, diameter: float | None = None
) -> FramePoints:
    """Return the known points of a frame, by the thresholds of the rig's only camera.

    free_resolution: metres. diameter: of the object, metres; without a workspace in the rig, it is
    the bounds of the surface points, padded by this. Raise SettingError for a rig that does not
    fit, SessionError for a frame without a usable pixel.
    """
    if len(rig.cameras) != 1:
        raise SettingError(f"rig {rig.name} has {len(rig.cameras)} cameras; accepted: 1, a frame's")
    (camera,) = rig.cameras
    nearest, furthest = camera.range
    valid = valid_pixels(frame.depth, nearest=nearest, furthest=furthest)
    if not valid.any():
        typical = float(np.median(frame.depth[np.isfinite(frame.depth) & (frame.depth > 0.0)]))
        raise SessionError(
            f"no pixel of depth lies in the range of camera {camera.name}, {nearest:g} m to "
            f"{furthest:g} m; its median is {typical:.4g} m: check depth_scale"
        )
    view = View(frame.depth, valid, camera=frame.camera, world_from_camera=frame.world_from_camera)
    edges = edge_pixels(camera, view)
    measured = frame.camera.back_project(frame.depth)
    counts = Counts(images=1, used=1, pixels=valid.size, invalid=int((~valid).sum()))
    counts.edges = int(edges.sum())
    rays = valid & ~edges
    surface = np.zeros_like(valid)
    labelled = None
    if frame.label is not None:
        surface, labelled = _surface_pixels(
            frame.label, view, edges=edges, rig=rig, measured=measured, diameter=diameter
        )
        rays &= surface | ~frame.label
        counts.outline = labelled.outline
        counts.far = labelled.far
        counts.small = labelled.small
    on_object = apply(frame.world_from_camera, measured[surface])
    workspace = _workspace(rig, on_object, diameter=diameter)
    grid = FreeGrid(workspace, free_resolution)  # there is one view, whatever the rig asks
    _, small = mark_rays(grid, camera, gate=rig.gate, view=view, usable=rays)
    counts.small += small
    points = KnownPoints(
        free=outside_of(on_object, grid.new(), spacing=free_resolution),
        known=one_per_voxel(on_object, rig.surface_resolution),
    )
    counts.contacts, counts.free = len(points.known), len(points.free)
    return FramePoints(
        points, workspace, rays=rays, surface=surface, counts=counts, labelled=labelled
    )


def _surface_pixels(
    label: BoolArray,
    view: View,
    *,
    edges: BoolArray,
    rig: Rig,
    measured: FloatArray,
    diameter: float | None,
) -> tuple[BoolArray, Counts]:
    """Return the object's pixels (H, W) but for those at its outline, where others are mixed in.

    Of these, those in regions that can be the object's; the others are counted by reason.
    """
    from scipy.ndimage import binary_erosion

    square = np.ones((3, 3), dtype=bool)
    valid = view.valid
    within = binary_erosion(label, square, iterations=LABEL_MARGIN, border_value=1)
    surface = within & valid & ~edges
    if not surface.any():
        raise SessionError(
            f"none of the {int(label.sum())} pixels of label is of the surface: outlines "
            "and edges of depth are left out, and pixels out of range"
        )
    regions = depth_regions(view.metres, surface, camera=view.camera, jump=rig.gate.jump)
    found = main_regions(
        regions[surface], part=rig.gate.part, points=measured[surface], diameter=diameter
    )
    surface[surface] = found.kept
    counts = Counts(images=1, used=1, pixels=int(label.sum()), small=found.small, far=found.far)
    counts.invalid = int((label & ~valid).sum())
    counts.edges = int((label & edges).sum())
    counts.outline = int((label & valid & ~edges & ~within).sum())
    return surface, counts


def _workspace(rig: Rig, on_object: FloatArray, *, diameter: float | None) -> Workspace:
    if rig.workspace is not None:
        return rig.box()
    if len(on_object) == 0 or diameter is None:
        raise SettingError(
            "workspace is missing, and no label says where the object is; accepted: "
            "[[x0, x1], [y0, y1], [z0, z1]]"
        )
    return Workspace.around(on_object, diameter)
