"""A hand that motion capture has followed, beside a log without transforms of it."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import SessionError, SettingError
from chsel.problem.poses import quaternions
from runners.sensors.rig import TrajectoryRig
from tests.runners.sensors.small_logs import BEGIN, SECOND
from tests.runners.sensors.test_forces import hand_pose, read, write_log

TICKS = 0.01 * np.arange(401)
STAMPS = BEGIN + np.rint(TICKS * SECOND).astype(np.int64)
HAND = TrajectoryRig("hand.csv", "euroc", parent="world", child="hand")


def write_trajectory(folder, rig=HAND, *, shift=0):
    """The poses of the hand of the log in a file; shift: of its clock, nanoseconds."""
    poses = np.array([hand_pose(seconds) for seconds in TICKS])
    if rig.kind == "kitti":
        rows = [" ".join(repr(float(n)) for n in pose[:3].ravel()) for pose in poses]
        times = [repr(float(stamp / SECOND)) for stamp in STAMPS]
        (folder / rig.times).write_text("\n".join(times))
    else:
        turns = quaternions(poses[:, :3, :3])[:, [3, 0, 1, 2]]
        numbers = np.concatenate([poses[:, :3, 3], turns], axis=1)
        rows = [
            ",".join([str(stamp + shift), *(repr(float(n)) for n in row)])
            for stamp, row in zip(STAMPS.tolist(), numbers, strict=True)
        ]
    (folder / rig.file).write_text("\n".join(rows))


def points_of(path, **changes):
    points = read(path, **changes)[1].new_points
    return np.unique(points.free, axis=0), points.known


@pytest.mark.parametrize(
    ("rig", "shift"),
    [
        (HAND, 0),
        (replace(HAND, offset=2.0), -2 * SECOND),
        (replace(HAND, file="hand.txt", kind="kitti", times="times.txt"), 0),
    ],
)
def test_points_are_those_of_the_same_motion_in_the_log(tmp_path, rig, shift):
    whole = tmp_path / "whole.mcap"
    write_log(whole)
    free, known = points_of(whole)
    assert len(free) > 100
    path = tmp_path / "alone.mcap"
    write_log(path, lacks="/tf")
    write_trajectory(tmp_path, rig, shift=shift)
    found = points_of(path, trajectories=(rig,))
    np.testing.assert_allclose(found[1], known, atol=1e-6)
    assert len(found[0]) == len(free)
    np.testing.assert_allclose(found[0], free, atol=1e-9)


def test_a_trajectory_of_another_time_or_frame_is_one_line(tmp_path):
    path = tmp_path / "alone.mcap"
    write_log(path, lacks="/tf")
    write_trajectory(tmp_path, shift=100 * SECOND)
    with pytest.raises(SessionError, match=r"hand in world is not known at .* s after"):
        read(path, trajectories=(HAND,))
    write_trajectory(tmp_path)
    with pytest.raises(
        SessionError, match=r"frame world is in no transform; there are ft, hand, mocap"
    ):
        read(path, trajectories=(replace(HAND, parent="mocap"),))
    with pytest.raises(SessionError, match=r"trajectory .*none\.csv: it does not exist"):
        read(path, trajectories=(replace(HAND, file="none.csv"),))


def test_times_are_needed_for_kitti_and_as_many_as_poses(tmp_path):
    with pytest.raises(SettingError, match="times=FILE for kitti"):
        replace(HAND, kind="kitti")
    with pytest.raises(SettingError, match="times=FILE for kitti"):
        replace(HAND, times="times.txt")
    rig = replace(HAND, file="hand.txt", kind="kitti", times="times.txt")
    path = tmp_path / "alone.mcap"
    write_log(path, lacks="/tf")
    write_trajectory(tmp_path, rig)
    (tmp_path / "times.txt").write_text("1\n2\n")
    with pytest.raises(SessionError, match="it has 2 times, and the trajectory 401 poses"):
        read(path, trajectories=(rig,))
