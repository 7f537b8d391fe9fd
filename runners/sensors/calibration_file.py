"""Calibrations of cameras as OpenCV and ROS write them in YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.sensing.depth_camera import PinholeCamera
from chsel.sensing.lens import BROWN, LensDistortion
from runners.sensors.pose_file import read_yaml

_MATRIX, _LENS = "camera_matrix", "distortion_coefficients"
_FEW = 5  # coefficients of plumb_bob, at most
_ACCEPTED = (
    f"accepted: YAML with {_MATRIX} and {_LENS}, each with rows, cols and data, and image_width "
    "and image_height, as cv::FileStorage and camera_calibration write it"
)


def read_calibration(
    path: Path, *, width: int, height: int
) -> tuple[PinholeCamera, LensDistortion | None]:
    """Return the camera of images of a size, pixels, and its lens; None: it distorts nothing.

    Raise SessionError, which names the file, for a file of another form or size.
    """
    try:
        values = read_yaml(path)
        for key, size in (("image_width", width), ("image_height", height)):
            if values.get(key) != size:
                raise SessionError(f"{key} is {values.get(key)}, and that of the image {size}")
        matrix = _numbers(values, _MATRIX)
        if len(matrix) != 9:
            raise SessionError(f"{_MATRIX} has {len(matrix)} numbers, and not 9")
        camera = PinholeCamera.of_matrix(matrix.reshape(3, 3), width, height=height)
        coefficients = tuple(_numbers(values, _LENS).tolist())
        if not any(coefficients):
            return camera, None
        return camera, LensDistortion(_model(values, len(coefficients)), coefficients)
    except ChselError as error:
        raise SessionError(f"calibration {path}: {error}; {_ACCEPTED}") from None


def _model(values: Mapping[Any, Any], count: int) -> str:
    """Return the model of the lens: the one that is named, or of OpenCV by their number."""
    if values.get("fisheye_model"):
        return "fisheye"
    named = values.get("distortion_model", "")
    return str(named) if named else BROWN[count > _FEW]


def _numbers(values: Mapping[Any, Any], key: str) -> FloatArray:
    """Return the numbers (N,) of a matrix in the file. Raise SessionError if there is none."""
    given = values.get(key)
    if not isinstance(given, Mapping) or "data" not in given:
        raise SessionError(f"no {key}; it has {', '.join(map(str, values))}")
    return frozen(f"{key}.data", given["data"], shape=(None,), error=SessionError)
