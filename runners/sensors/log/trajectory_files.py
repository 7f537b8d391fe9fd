"""Files of trajectories beside a log, as transforms."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.sensing.trajectory import read_trajectory
from runners.sensors.log.messages import Received, TransformMessage
from runners.sensors.rig import TrajectoryRig

_NANOSECONDS = 1e9


def trajectory_files(rigs: tuple[TrajectoryRig, ...], folder: Path) -> list[Path]:
    """Return all files that trajectories of a log in a folder are read from."""
    names = [name for rig in rigs for name in (rig.file, rig.times) if name is not None]
    return [folder / Path(name).expanduser() for name in names]


def trajectory_messages(rig: TrajectoryRig, folder: Path) -> Iterator[Received]:
    """Yield the poses of a file as transforms, in the order of time.

    Raise SessionError, which names the file, if it cannot be used.
    """
    path = folder / Path(rig.file).expanduser()
    try:
        seconds, poses = read_trajectory(path, rig.kind)
    except ChselError as error:
        raise SessionError(str(error)) from None
    if seconds is None:
        seconds = _times(folder / Path(rig.times or "").expanduser(), len(poses))
    for time, pose in zip(np.rint(_NANOSECONDS * (seconds + rig.offset)), poses, strict=True):
        content = TransformMessage(rig.parent, rig.child, parent_from_child=pose)
        yield Received(path.name, int(time), stamp=int(time), content=content)


def _times(path: Path, count: int) -> FloatArray:
    """Return the times (N,) of a file, seconds."""
    try:
        times = frozen("times", [float(part) for part in path.read_text().split()], shape=(None,))
        if len(times) != count:
            raise SessionError(f"it has {len(times)} times, and the trajectory {count} poses")
        if (np.diff(times) < 0.0).any():
            raise SessionError("a time is before that of the row above")
        return times
    except (OSError, ValueError, ChselError) as error:
        reason = " ".join(str(error).split())
        raise SessionError(
            f"times {path}: {reason}; accepted: a file of seconds, one a row of the trajectory"
        ) from None
