"""Foxglove's messages: exact where they are the only copy, right where they are a view."""

from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from scipy.spatial.transform import Rotation

from chsel.errors import RecordingError
from chsel.problem.poses import compose
from replay.mcap.foxglove_messages import (
    cloud_points,
    log_level_and_text,
    point_cloud,
)
from replay.mcap.viewer_messages import poses_in_world


def quaternions(world_from_body: np.ndarray) -> np.ndarray:
    poses = PosesInFrame.FromString(poses_in_world(world_from_body, 0)).poses
    return np.array([[getattr(pose.orientation, name) for name in "xyzw"] for pose in poses])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, 3.0, 1e-9])
def test_a_turn_about_an_axis_has_the_textbook_quaternion(axis, angle):
    vector = np.zeros(3)
    vector[axis] = angle
    rotation = Rotation.from_rotvec(vector).as_matrix()
    quaternion = quaternions(compose(rotation[None], np.zeros((1, 3))))[0]
    expected = np.zeros(4)
    expected[axis], expected[3] = np.sin(angle / 2), np.cos(angle / 2)
    quaternion *= np.sign(quaternion @ expected)
    np.testing.assert_allclose(quaternion, expected, atol=1e-15)


def test_quaternions_of_random_rotations_turn_vectors_alike():
    rotations = Rotation.random(500, random_state=1).as_matrix()
    found = quaternions(compose(rotations, np.ones((500, 3))))
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), rotations, atol=1e-14)


def test_clouds_keep_every_bit():
    points = np.array([[0.0, -0.0, 5e-324, 1.7976931348623157e308], [1 / 3, np.pi, -1e-17, 0.1]])
    assert cloud_points(point_cloud(points, 5), 4).tobytes() == points.tobytes()


def test_clouds_of_other_fields_are_refused():
    with pytest.raises(RecordingError, match="other fields than x, y, z, sdf as float64"):
        cloud_points(point_cloud(np.zeros((2, 3)), 0), 4)


def test_timestamps_are_those_of_the_log():
    message = PosesInFrame.FromString(poses_in_world(np.eye(4)[None], 3_000_000_007))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (3, 7)


def test_log_levels_of_other_programs_are_refused():
    with pytest.raises(RecordingError, match="level 5"):
        log_level_and_text(Log(level=Log.FATAL, message="x").SerializeToString())
