"""One depth image as plain files: a YAML that names the image, its intrinsics and its pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from chsel.errors import ChselError, SessionError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray, frozen
from chsel.problem.file_checks import refuse_special_file
from chsel.problem.poses import nearest_rigid
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.image_file import read_image

SUFFIXES = (".yaml", ".yml")
MOST_BYTES = 2**16
_DEEPEST = 8  # level of nested lists and mappings; a frame has 3
_MOST_LISTED = 20
_NEEDED = ("depth", "intrinsics")
_OPTIONAL = (
    "depth_scale",
    "label",
    "object",
    "object_class",
    "world_from_camera",
    "world_from_object",
)
_REMARKS = ("factor_depth_in_file", "comment", "licence", "license", "source")
_INTRINSICS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth image and what is known of it.

    depth (H, W): metres along the optical axis; 0 or not finite where there is no measurement.
    world_from_camera (4, 4): of the optical centre, x right, y down, z forward. label (H, W): the
    pixels of the object, if it was told apart. world_from_object (4, 4): the true pose, where
    known. mesh: file of the object, where named.
    """

    camera: PinholeCamera
    depth: FloatArray
    world_from_camera: FloatArray
    label: BoolArray | None = None
    world_from_object: FloatArray | None = None
    mesh: Path | None = None


def read_depth_frame(path: str | Path) -> DepthFrame:
    """The frame that a YAML describes; paths in it are relative to it.

    depth: .png or .tiff of integers, .tiff or .npy of floating point; depth_scale: metres a unit,
    by default 0.001 for integers and 1 for floating point. intrinsics: fx, fy, cx, cy, pixels.
    label: image of classes, object_class: the object's; by default all but 0. world_from_camera:
    by default the camera's frame is the world. world_from_object, object: true pose and mesh.
    Raises SessionError, which names the file and the key.
    """
    path = Path(path).expanduser()
    try:
        return _frame(_values(path), path.parent)
    except ChselError as error:
        raise SessionError(f"depth frame {path}: {error}") from None


def _frame(values: Mapping[str, Any], folder: Path) -> DepthFrame:
    depth = _depth(values, folder)
    world_from_camera = _pose(values, "world_from_camera")
    mesh = _file(values, "object", folder)
    return DepthFrame(
        camera=_camera(values["intrinsics"], depth.shape),
        depth=depth,
        world_from_camera=np.eye(4) if world_from_camera is None else world_from_camera,
        label=_label(values, folder, depth.shape),
        world_from_object=_pose(values, "world_from_object"),
        mesh=mesh,
    )


def _values(path: Path) -> Mapping[str, Any]:
    if path.suffix.lower() not in SUFFIXES:
        raise SessionError(f"of no known kind; accepted: {', '.join(SUFFIXES)}")
    refuse_special_file("it", path, SessionError)
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror}); accepted: a YAML file") from None
    if len(data) > MOST_BYTES:
        raise SessionError(f"too large; accepted: at most {MOST_BYTES} bytes")
    values = _parsed(data)
    accepted = (*_NEEDED, *_OPTIONAL, *_REMARKS)
    if not isinstance(values, dict):
        raise SessionError(f"no mapping of keys to values; accepted: {', '.join(accepted)}")
    for key in values:
        if key not in accepted:
            raise SessionError(f"{_short(key)} does not exist; accepted: {', '.join(accepted)}")
    for key in _NEEDED:
        if values.get(key) is None:
            raise SessionError(f"{key} is missing; accepted: {', '.join(accepted)}")
    return values


def _parsed(data: bytes) -> Any:
    """The values in YAML of a few levels without aliases, which could unfold to any size."""
    depth = 0
    try:
        for event in yaml.parse(data, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                raise SessionError("an alias (*) in the YAML; accepted: values themselves")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise SessionError(f"nested too deep; accepted: {_DEEPEST} levels")
        return yaml.safe_load(data)
    except (yaml.YAMLError, ValueError) as error:
        raise SessionError(f"not YAML ({_short(' '.join(str(error).split()))})") from None


def _depth(values: Mapping[str, Any], folder: Path) -> FloatArray:
    """Metres (H, W)."""
    path = _file(values, "depth", folder)
    assert path is not None
    stored = read_image(path, "depth")
    if stored.dtype == np.uint8:
        raise SessionError(f"depth {path}: 8 bits a pixel; accepted: 16, or floating point")
    unit = 0.001 if stored.dtype.kind in "ui" else 1.0
    if values.get("depth_scale") is not None:
        unit = _number("depth_scale", values["depth_scale"])
        if unit <= 0.0:
            raise SessionError(f"depth_scale is {unit:g}; accepted: metres a unit, above 0")
    with np.errstate(all="ignore"):
        depth = stored.astype(np.float64) * unit
    if not ((depth > 0.0) & np.isfinite(depth)).any():
        raise SessionError(f"depth {path}: no pixel has a measurement; accepted: values above 0")
    return depth


def _camera(intrinsics: Any, shape: tuple[int, ...]) -> PinholeCamera:
    accepted = f"accepted: {', '.join(_INTRINSICS)}, pixels"
    if not isinstance(intrinsics, dict) or set(intrinsics) != set(_INTRINSICS):
        raise SessionError(f"intrinsics is {_short(intrinsics)}; {accepted}")
    numbers = {name: _number(f"intrinsics.{name}", intrinsics[name]) for name in _INTRINSICS}
    try:
        return PinholeCamera(width=shape[1], height=shape[0], **numbers)
    except SettingError as error:
        raise SessionError(f"intrinsics: {error}") from None


def _label(values: Mapping[str, Any], folder: Path, shape: tuple[int, ...]) -> BoolArray | None:
    wanted = values.get("object_class")
    path = _file(values, "label", folder)
    if path is None:
        if wanted is not None:
            raise SessionError("object_class without label; accepted: both, or label alone")
        return None
    classes = read_image(path, "label")
    if classes.dtype.kind not in "ui":
        raise SessionError(f"label {path}: floating point; accepted: whole numbers")
    if classes.shape != shape:
        (height, width), (rows, columns) = shape, classes.shape
        raise SessionError(
            f"label {path}: {columns} x {rows} pixels; accepted: those of depth, {width} x {height}"
        )
    if wanted is not None and (type(wanted) is not int or wanted < 0):
        raise SessionError(f"object_class is {_short(wanted)}; accepted: a whole number, from 0")
    mask = classes != 0 if wanted is None else classes == wanted
    if not mask.any():
        present = ", ".join(map(str, np.unique(classes)[:_MOST_LISTED].tolist()))
        raise SessionError(f"object_class {wanted} is not in label; accepted: {present}")
    return mask


def _pose(values: Mapping[str, Any], key: str) -> FloatArray | None:
    """A rigid transform (4, 4), its rotation made exact."""
    rows = values.get(key)
    if rows is None:
        return None
    try:
        matrix = frozen(key, rows, (4, 4), error=SessionError)
    except OverflowError:
        raise SessionError(f"{key} holds a number out of range; accepted: (4, 4)") from None
    return nearest_rigid(key, matrix[None])[0]


def _file(values: Mapping[str, Any], key: str, folder: Path) -> Path | None:
    name = values.get(key)
    if name is None:
        return None
    if not isinstance(name, str) or not name or len(name) > 1000 or "\0" in name:
        raise SessionError(f"{key} is {_short(name)}; accepted: the path of a file")
    return folder / Path(name).expanduser()


def _number(key: str, value: Any) -> float:
    fits = type(value) in (int, float) and abs(value) < 1e9  # which nan is not
    if not fits:
        raise SessionError(f"{key} is {_short(value)}; accepted: a finite number")
    return float(value)


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        text = "a number out of range"
    return text if len(text) <= 80 else text[:77] + "..."
