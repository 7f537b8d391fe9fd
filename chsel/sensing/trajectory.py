"""Trajectories of motion capture and SLAM: poses over time in the text files of TUM, KITTI, EuRoC.

The conventions are those of evo (https://github.com/MichaelGrupp/evo): the kind of a file says what
its numbers are, and above all in which order quaternions are.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from chsel.errors import ChselError, PoseError, require_choice
from chsel.numerics.arrays import FloatArray, frozen, refuse_special_file
from chsel.problem.points import FARTHEST_PLACE
from chsel.problem.poses import compose, nearest_rigid, rotation_matrices

TRAJECTORIES = {
    "tum": "8 numbers a row: seconds x y z qx qy qz qw",
    "kitti": "12 numbers a row: the upper three rows of a pose (4, 4)",
    "euroc": "8 numbers a row or more, with commas: nanoseconds, x, y, z, qw, qx, qy, qz",
}
"""The kinds of files, with what their rows are; positions in metres."""

_NUMBERS = {"tum": 8, "kitti": 12, "euroc": 8}  # a row; behind those of euroc there may be more
_NANOSECONDS = 1e-9
_OFF_UNIT = 0.01  # of a quaternion's length: files round to four digits


class Trajectory(NamedTuple):
    """Poses over time."""

    seconds: FloatArray | None  # (N,), by the clock of the file; None where it has no times
    poses: FloatArray  # (N, 4, 4), of what was followed, in the frame that it was followed in


def read_trajectory(path: str | Path, kind: str) -> Trajectory:
    """Return the poses of a file of a kind of TRAJECTORIES; lines with # are comments.

    For `Session.add(hand=mesh, path=poses)`, say. Raise SettingError for another kind, and
    PoseError, which names the file and the row, for rows that are none of it.
    """
    require_choice("kind", kind, accepted=tuple(TRAJECTORIES))
    path = Path(path).expanduser()
    try:
        if not path.is_file():
            raise PoseError("it does not exist")
        refuse_special_file("trajectory", path, error=PoseError)
        rows = _rows(path, kind)
        if kind == "kitti":
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3] = rows.reshape(-1, 3, 4)
            return Trajectory(None, _checked(poses))
        seconds = rows[:, 0]
        places = rows[:, 1:4]
        quaternion = rows[:, 4:8]
        if kind == "euroc":
            seconds = _NANOSECONDS * seconds
            quaternion = np.roll(quaternion, -1, axis=1)  # to x, y, z, w
        back = np.flatnonzero(np.diff(seconds) < 0.0)
        if len(back):
            raise PoseError(f"row {back[0] + 2}: its time is before that of the row above")
        length = np.sqrt((quaternion**2).sum(axis=1, keepdims=True))
        wrong = np.flatnonzero(np.abs(length[:, 0] - 1.0) > _OFF_UNIT)
        if len(wrong):
            row = int(wrong[0])
            raise PoseError(f"row {row + 1}: its quaternion has the length {length[row, 0]:.4g}")
        return Trajectory(
            seconds, _checked(compose(rotation_matrices(quaternion / length), places))
        )
    except (ChselError, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise PoseError(
            f"trajectory {path}: {reason}; accepted: of kind {kind} {TRAJECTORIES[kind]}"
        ) from None


def _checked(poses: FloatArray) -> FloatArray:
    """Return rigid poses (N, 4, 4) within reach. Raise PoseError for others."""
    poses = frozen("row", poses, shape=(None, 4, 4), error=PoseError, most=FARTHEST_PLACE)
    return nearest_rigid("row", poses)


def _rows(path: Path, kind: str) -> FloatArray:
    """Return the numbers (N, M) of all rows. Raise PoseError unless they are as many as wanted."""
    separator = "," if kind == "euroc" else None
    least = _NUMBERS[kind]
    most = np.inf if kind == "euroc" else least
    rows: list[list[float]] = []
    for number, text in enumerate(path.read_text().splitlines(), 1):
        line = text.partition("#")[0].strip()
        if not line:
            continue
        parts = line.split(separator)
        if not least <= len(parts) <= most:
            raise PoseError(f"line {number} has {len(parts)} numbers")
        try:
            rows.append([float(part) for part in parts[:least]])
        except ValueError as error:
            raise PoseError(f"line {number}: {error}") from None
    if not rows:
        raise PoseError("it has no rows")
    values = np.array(rows)
    if not np.isfinite(values).all():
        raise PoseError(f"row {int(np.argwhere(~np.isfinite(values))[0][0]) + 1} is not finite")
    return values
