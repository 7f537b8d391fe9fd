"""One depth image as plain files: a YAML that names the image, its intrinsics and its pose."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import BoolArray, FloatArray, frozen
from chsel.problem.poses import nearest_rigid
from chsel.problem.settings import CheckedSettings, build_settings, not_negative, positive
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.depth_camera import metres
from runners.sensors.log.images import read_image
from runners.sensors.yaml_file import read_yaml

SUFFIXES = (".yaml", ".yml")
MOST_BYTES = 2**16
_MOST_LISTED = 20
_LONGEST_PATH = 1000  # characters


def _path(name: str, value: Any) -> None:
    """The path of a file."""
    if not value or len(value) > _LONGEST_PATH or "\0" in value:
        raise SessionError(f"{name} is {value[:80]!r}; accepted: the path of a file")


FilePath = Annotated[str, _path]


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

    depth: FilePath  # .png or .tiff of integers, .tiff or .npy of floating point
    intrinsics: Intrinsics
    depth_scale: Annotated[float | None, positive] = None
    """Metres a unit; null: 0.001 for integers, 1 for floating point."""

    label: Annotated[str | None, _path] = None  # image of classes
    object_class: Annotated[int | None, not_negative] = None  # the object's; null: all but 0
    object: Annotated[str | None, _path] = None  # mesh of the object
    world_from_camera: tuple[Any, ...] | None = None  # (4, 4); null: the camera is the world
    world_from_object: tuple[Any, ...] | None = None  # (4, 4), the true pose
    factor_depth_in_file: Any = None  # this and the following keys are for people
    comment: Any = None
    licence: Any = None
    license: Any = None
    source: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
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
    """The frame that a YAML describes with the keys of `FrameFile`.

    Raises SessionError, which names the file and the key.
    """
    path = Path(path).expanduser()
    try:
        if path.suffix.lower() not in SUFFIXES:
            raise SessionError(f"of no known kind; accepted: {', '.join(SUFFIXES)}")
        return _frame(build_settings(FrameFile, read_yaml(path, MOST_BYTES), "frame"), path.parent)
    except ChselError as error:
        raise SessionError(f"depth frame {path}: {error}") from None
    except (OverflowError, ValueError):  # an integer of thousands of digits
        raise SessionError(f"depth frame {path}: a number out of range") from None


def _frame(file: FrameFile, folder: Path) -> DepthFrame:
    depth = _depth(file, _beside(folder, file.depth))
    height, width = depth.shape
    world_from_camera = _pose("world_from_camera", file.world_from_camera)
    label = None if file.label is None else _label(file, _beside(folder, file.label), depth.shape)
    return DepthFrame(
        camera=PinholeCamera(width=width, height=height, **asdict(file.intrinsics)),
        depth=depth,
        world_from_camera=np.eye(4) if world_from_camera is None else world_from_camera,
        label=label,
        world_from_object=_pose("world_from_object", file.world_from_object),
        mesh=None if file.object is None else _beside(folder, file.object),
    )


def _beside(folder: Path, name: str) -> Path:
    return folder / Path(name).expanduser()


def _depth(file: FrameFile, path: Path) -> FloatArray:
    """Metres (H, W)."""
    stored = read_image(path, "depth")
    if stored.dtype == np.uint8:
        raise SessionError(f"depth {path}: 8 bits a pixel; accepted: 16, or floating point")
    with np.errstate(all="ignore"):
        depth = metres(stored, file.depth_scale)
    if not ((depth > 0.0) & np.isfinite(depth)).any():
        raise SessionError(f"depth {path}: no pixel has a measurement; accepted: values above 0")
    return depth


def _label(file: FrameFile, path: Path, shape: tuple[int, ...]) -> BoolArray:
    """The object's pixels (H, W)."""
    classes = read_image(path, "label")
    if classes.dtype.kind not in "ui":
        raise SessionError(f"label {path}: floating point; accepted: whole numbers")
    if classes.shape != shape:
        (height, width), (rows, columns) = shape, classes.shape
        raise SessionError(
            f"label {path}: {columns} x {rows} pixels; accepted: those of depth, {width} x {height}"
        )
    mask = classes != 0 if file.object_class is None else classes == file.object_class
    if not mask.any():
        present = ", ".join(map(str, np.unique(classes)[:_MOST_LISTED].tolist()))
        raise SessionError(f"object_class {file.object_class} is not in label; accepted: {present}")
    return mask


def _pose(name: str, rows: Any) -> FloatArray | None:
    """A rigid transform (4, 4), its rotation made exact."""
    if rows is None:
        return None
    return nearest_rigid(name, frozen(name, rows, (4, 4), error=SessionError)[None])[0]
