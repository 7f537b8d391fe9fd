"""The file of a pose that a person set: written, read and refused."""

import numpy as np
import pytest
import yaml

from chsel.errors import RecordingError, SessionError
from chsel.problem.poses import compose, rotation_vector
from runners.sensors.pose_file import beside, read_pose, write_pose

POSE = compose(rotation_vector(np.array([0.3, -1.2, 0.4])), np.array([0.9, -0.05, 0.31]))
ROWS = "world_from_object: [[1,0,0,0.5],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"


def test_a_pose_is_read_as_it_was_written_and_replaced_if_that_is_wanted(tmp_path):
    path = beside(tmp_path / "a.b.mcap")
    assert path == beside(tmp_path / "a.b") == tmp_path / "a.b.pose.yaml"
    write_pose(path, POSE, about={"cost": 0.25, "search": {"spans": (1, 2)}})
    with pytest.raises(RecordingError, match="exists; accepted: the name of a new file"):
        write_pose(path, np.eye(4), about={})
    np.testing.assert_allclose(read_pose(path), POSE, atol=1e-15)
    written = yaml.safe_load(path.read_text())
    assert (written["cost"], written["search"]) == (0.25, {"spans": [1, 2]})
    write_pose(path, np.eye(4), about={}, overwrite=True)
    np.testing.assert_array_equal(read_pose(path), np.eye(4))


def test_a_rotation_written_by_hand_is_made_exact(tmp_path):
    path = tmp_path / "hand.yaml"
    rows = [[0.866, -0.5, 0, 0.9], [0.5, 0.866, 0, 0], [0, 0, 1, 0.31], [0, 0, 0, 1]]
    path.write_text(f"world_from_object: {rows}")
    rotation = read_pose(path)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.arctan2(rotation[1, 0], rotation[0, 0]), np.pi / 6, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no mapping of keys to values"),
        ("world_from_object: [1, 2, 3]", r"world_from_object has shape \(3,\)"),
        ("x: 1", "accepted: YAML with world_from_object"),
        (ROWS.replace("0.5", ".nan"), "not finite"),
        (ROWS.replace("[[1,", "[[2,"), "world_from_object.* not a rigid"),
        ("world_from_object: [[[", "not YAML"),
        (None, r"pose file .* cannot be read"),
    ],
)
def test_another_file_is_one_line(tmp_path, text, message):
    path = tmp_path / "pose.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(SessionError, match=message) as error:
        read_pose(path)
    assert "\n" not in str(error.value)
    assert "accepted: YAML with world_from_object" in str(error.value)
