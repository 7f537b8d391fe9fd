"""Files of trajectories, each in the convention of its kind."""

import numpy as np
import pytest

from chsel.errors import PoseError, SettingError
from chsel.problem.poses import axis_angle, compose
from chsel.sensing.trajectory import read_trajectory

QUARTER = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5 * np.pi))  # about z
POSES = compose(np.stack([np.eye(3), QUARTER]), np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]]))
HALF = 0.5**0.5
TEXTS = {
    "tum": "# time x y z qx qy qz qw\n1.5 0.1 0.2 0.3 0 0 0 1\n\n"
    f"1.75 -0.4 0.5 0.6 0 0 {HALF:.4f} {HALF:.4f}\n",
    "kitti": "1 0 0 0.1 0 1 0 0.2 0 0 1 0.3\n0 -1 0 -0.4 1 0 0 0.5 0 0 1 0.6\n",
    "euroc": "#timestamp, x, y, z, w, x, y, z, v\n1500000000,0.1,0.2,0.3,1,0,0,0,9\n"
    f"1750000000,-0.4,0.5,0.6,{HALF},0,0,{HALF},9\n",
}


def written(folder, text):
    path = folder / "hand.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", TEXTS)
def test_each_kind_has_its_order_of_numbers(kind, tmp_path):
    found = read_trajectory(written(tmp_path, TEXTS[kind]), kind)
    np.testing.assert_allclose(found.poses, POSES, atol=1e-12)
    if kind == "kitti":
        assert found.seconds is None
    else:
        np.testing.assert_allclose(found.seconds, [1.5, 1.75])


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("kitti", TEXTS["tum"], "line 2 has 8 numbers; accepted: of kind kitti 12 numbers a row"),
        ("tum", TEXTS["kitti"], "line 1 has 12 numbers; accepted: of kind tum 8 numbers a row"),
        ("tum", TEXTS["euroc"], "line 2 has 1 numbers"),
        ("euroc", TEXTS["tum"], "line 2 has 1 numbers"),
        ("tum", "1 0 0 0 0 0 0 0.9\n", "row 1: its quaternion has the length 0.9"),
        ("tum", "1 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1\n", "row 2: its time is before"),
        ("tum", "1 0 nan 0 0 0 0 1\n", "row 1 is not finite"),
        ("tum", "1 0 O 0 0 0 0 1\n", "line 1: could not convert"),
        ("tum", "1 0 2e6 0 0 0 0 1\n", "has 2e\\+06; accepted: up to 100000"),
        ("kitti", "1 0 0 0 0 2 0 0 0 0 1 0\n", "row"),
        ("tum", "# nothing\n", "it has no rows"),
    ],
)
def test_what_is_not_of_the_kind_is_one_line(kind, text, message, tmp_path):
    path = written(tmp_path, text)
    with pytest.raises(PoseError, match=rf"^trajectory .*hand\.txt: .*{message}"):
        read_trajectory(path, kind)


def test_a_kind_is_never_guessed(tmp_path):
    with pytest.raises(SettingError, match="kind is 'auto'; accepted: tum, kitti, euroc"):
        read_trajectory(written(tmp_path, TEXTS["tum"]), "auto")
    with pytest.raises(PoseError, match="it does not exist"):
        read_trajectory(tmp_path / "none.txt", "tum")
