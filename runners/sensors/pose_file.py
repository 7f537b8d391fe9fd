"""YAML files from outside, and those that say where the object of a session is, beside its log."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import FloatArray, frozen, refuse_special_file
from chsel.problem.poses import nearest_rigid
from replay.files import new_file, whole_file

SUFFIX = ".pose.yaml"
KEY = "world_from_object"
_ACCEPTED = (
    f"accepted: YAML with {KEY}, four rows of four numbers: a rotation and a position in metres, "
    "last row 0 0 0 1"
)


_OF_OPENCV = b"%YAML:1.0"  # first line of cv::FileStorage before OpenCV 5, which no YAML has


class _Loader(yaml.SafeLoader):
    """Reads 1e-3 as a number, as YAML 1.2 and the files of Hydra do; YAML 1.1 asks for 1.0e-3."""


# cv::FileStorage names the types of its matrices; they are mappings.
_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix",
    lambda loader, node: loader.construct_mapping(node, deep=True),
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_yaml(path: Path) -> dict[Any, Any]:
    """Return the mapping in a file. Raise SessionError, its text without the file's name."""
    refuse_special_file("it", path, error=SessionError)
    try:
        text = path.read_bytes()
        if text.startswith(_OF_OPENCV):
            text = text.partition(b"\n")[2]
        values = yaml.load(text, _Loader)
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SessionError(f"not YAML ({' '.join(str(error).split())[:100]})") from None
    if not isinstance(values, dict):
        raise SessionError("no mapping of keys to values")
    return values


def beside(path: str | Path) -> Path:
    """Return the place of a log's pose: X.pose.yaml beside X.mcap or folder X."""
    path = Path(path).absolute()
    return path.with_name(path.name.removesuffix(".mcap") + SUFFIX)


def read_pose(path: str | Path) -> FloatArray:
    """Return world_from_object (4, 4) of a file. Raise SessionError unless it is rigid."""
    path = Path(path).expanduser()
    try:
        return pose_of_rows(KEY, read_yaml(path).get(KEY))
    except ChselError as error:
        raise SessionError(f"pose file {path}: {error}; {_ACCEPTED}") from None


def pose_of_rows(name: str, rows: Any) -> FloatArray:
    """Return a rigid transform (4, 4) of a file; its rotation, of few digits, is made exact."""
    pose = nearest_rigid(name, frozen(name, rows, shape=(4, 4), error=SessionError)[None])[0]
    pose.setflags(write=False)
    return pose


def write_pose(
    path: Path, world_from_object: FloatArray, *, about: Mapping[str, Any], overwrite: bool = False
) -> None:
    """Write a pose (4, 4), and what a person may want to know about it, plain values.

    Raise RecordingError if there is such a file already, unless it may be overwritten, and
    ChselError if it cannot be written.
    """
    values = {KEY: np.asarray(world_from_object, dtype=np.float64).tolist(), **about}
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    with whole_file(path) if overwrite else new_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
