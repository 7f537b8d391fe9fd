"""A dataset that LeRobot has written, beside the log of the same session; see make_dataset.py."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from chsel.errors import SessionError, SettingError
from chsel.problem.poses import (
    apply,
    axis_angle,
    compose,
    inverse,
    quaternions,
    roll_pitch_yaw,
    rotation_vectors,
)
from chsel.problem.settings import build_settings
from runners.sensors.log.lerobot import LeRobotEpisode
from runners.sensors.rig import CloudRig, ColumnRig, ForceRig, Rig
from tests.runners.sensors.test_forces import (
    RIG,
    hand_pose,
    read,
    write_log,
)

DATASET = Path(__file__).parent / "lerobot"
POSE = ColumnRig(
    "observation.state",
    "pose",
    select=tuple(range(7)),
    parent="world",
    frame="hand",
    unit="mm",
    rotation="quaternion_wxyz",
)
WRENCH = ColumnRig("observation.wrench", "wrench", frame="hand", unit="N")
MARKER = ColumnRig("probe", "marker")
TAXELS = ColumnRig(
    "observation.taxels",
    "taxels",
    frame="hand",
    points=((0.0, 0.0, 0.1), (0.01, 0.0, 0.1), (0.02, 0.0, 0.1)),
    normals=((0.0, 0.0, -1.0),) * 3,
    threshold=0.5,
)
JOINTS = ColumnRig(
    "observation.joints",
    "joints",
    joints=("shoulder", "elbow"),
    unit="deg",
    urdf="arm.urdf",
    parent="world",
    frame="tip",
)
OF_DATASET = replace(
    RIG,
    columns=(POSE, WRENCH, MARKER),
    episode=1,
    markers="probe",
    forces=(ForceRig("observation.wrench"),),
)
URDF = """<robot name="arm"><link name="base"/><link name="upper"/><link name="lower"/>
<link name="tip"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.2 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.3 0 0"/>
</joint></robot>"""


@pytest.fixture
def copied(tmp_path):
    """A copy of the dataset, with a URDF."""
    folder = tmp_path / "dataset"
    shutil.copytree(DATASET, folder)
    (folder / "arm.urdf").write_text(URDF)
    return folder


def test_points_are_those_of_the_log_of_the_same_session(tmp_path):
    """The sensor's frame is fixed to the hand's: one rig has its transform, the other a log's."""
    whole = write_log(tmp_path / "log.mcap")
    _, expected, _ = read(whole)
    at_hand = replace(WRENCH, frame="ft")
    fixed = ColumnRig(
        "observation.joints",
        "joints",
        joints=("nothing", "more"),
        unit="rad",
        urdf="fixed.urdf",
        parent="hand",
        frame="ft",
    )
    folder = tmp_path / "dataset"
    shutil.copytree(DATASET, folder)
    roll, pitch, yaw = 0.3, -0.2, 0.9
    (folder / "fixed.urdf").write_text(
        '<robot name="wrist"><link name="flange"/><link name="ft"/><link name="a"/><link name="b"/>'
        '<joint name="mount" type="fixed"><parent link="flange"/><child link="ft"/>'
        f'<origin xyz="0 0.01 -0.06" rpy="{roll} {pitch} {yaw}"/></joint>'
        '<joint name="nothing" type="continuous"><parent link="flange"/><child link="a"/></joint>'
        '<joint name="more" type="continuous"><parent link="flange"/><child link="b"/></joint>'
        "</robot>"
    )
    columns = (POSE, at_hand, MARKER, fixed)
    _, found, _ = read(folder, **_changes(replace(OF_DATASET, columns=columns)))
    assert len(expected.contacts) > 1
    np.testing.assert_allclose(found.contacts, expected.contacts, atol=1e-5)
    free = {tuple(np.round(point, 6)) for point in found.new_points.free}
    wanted = {tuple(np.round(point, 6)) for point in expected.new_points.free}
    assert len(free & wanted) > 500
    # The others are on the hand's surface, exactly but for the 32 bits of the dataset.
    for x, y, z in free ^ wanted:
        assert min(abs(x - 0.3), abs(x - 0.5), abs(abs(y) - 0.03), abs(abs(z - 0.1) - 0.02)) < 1e-6


def _changes(rig):
    names = ("columns", "episode", "markers", "forces", "clouds", "hand", "annotations")
    return {name: getattr(rig, name) for name in names}


def test_a_joint_moves_its_link_by_the_urdf(copied):
    """Places of the tip by hand: the elbow turns down from the upper arm."""
    episode = LeRobotEpisode(copied, (JOINTS,), episode=1)
    contents = [one.content for one in episode.messages(["observation.joints"])]
    assert len(contents) == 2 * 401
    positions, moved = contents[-2:]
    assert positions == {
        "shoulder": pytest.approx(np.radians(40.0)),
        "elbow": pytest.approx(np.radians(-20.0)),
    }
    shoulder = axis_angle(np.array([0.0, 0.0, 1.0]), np.radians(40.0))
    elbow = axis_angle(np.array([0.0, 1.0, 0.0]), np.radians(-20.0))
    place = [0, 0, 0.1] + shoulder @ (np.array([0.2, 0, 0]) + elbow @ np.array([0.3, 0, 0]))
    expected = compose(shoulder @ elbow, place)
    np.testing.assert_allclose(moved.parent_from_child, expected, atol=1e-6)
    assert (moved.parent, moved.child) == ("world", "tip")


TURN = roll_pitch_yaw(np.array([0.3, -0.2, 0.9]))
QUATERNION = quaternions(TURN[None])[0]
ROTATIONS = {
    "quaternion_xyzw": (QUATERNION, None),
    "quaternion_wxyz": (np.roll(QUATERNION, 1), None),
    "rotation_vector": (np.degrees(rotation_vectors(TURN[None])[0]), "deg"),
    "roll_pitch_yaw": (np.array([0.3, -0.2, 0.9]), "rad"),
    "matrix": (TURN.ravel(), None),
}


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_a_rotation_is_as_the_rig_says(copied, rotation):
    numbers, angle = ROTATIONS[rotation]
    file = copied / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(file)
    row = [0.1, 0.2, 0.3, *numbers.tolist()]
    parquet.write_table(table.append_column("pose", pyarrow.array([row] * len(table))), file)
    info = copied / "meta" / "info.json"
    values = json.loads(info.read_text())
    values["features"]["pose"] = {"dtype": "float64", "shape": [len(row)], "names": None}
    info.write_text(json.dumps(values))
    column = replace(POSE, column="pose", select=(), unit="m", rotation=rotation, angle=angle)
    episode = LeRobotEpisode(copied, (column,), episode=0)
    found = [one.content.parent_from_child for one in episode.messages(["pose"])]
    expected = compose(TURN, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(found, [expected] * 3, atol=1e-12)


def test_taxels_that_are_pressed_are_contacts():
    rig = replace(
        OF_DATASET,
        columns=(POSE, TAXELS, MARKER),
        forces=(),
        clouds=(CloudRig("observation.taxels", "contacts", normals=10.0),),
    )
    _, probe, _ = read(DATASET, **_changes(rig))
    assert len(probe.contacts) > 3
    for contact in probe.contacts:  # the second taxel, where the hand was at some time
        away = apply(inverse(hand_pose(2.0)), contact[None])[0] - [0.01, 0.0, 0.1]
        np.testing.assert_allclose(away[:2], 0.0, atol=1e-6)
        assert -0.1 - 1e-6 <= away[2] <= 1e-6
    np.testing.assert_allclose(
        probe.new_points.normals, [[-1.0, 0.0, 0.0]] * len(probe.contacts), atol=1e-12
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": None}, "observation.state does not say unit, and no file of the dataset does"),
        ({"parent": None, "frame": None}, "does not say parent, frame"),
        ({"rotation": "rotation_vector"}, "does not say angle"),
        ({"rotation": "quaternion"}, "rotation is 'quaternion'; accepted: quaternion_xyzw"),
        ({"unit": "inch"}, "unit is 'inch'; accepted: m, cm, mm"),
        ({"select": (-1,)}, "select is"),
        ({"kind": "taxels"}, "does not say points, threshold"),
        ({"kind": "joints", "unit": "deg"}, "does not say joints"),
    ],
)
def test_what_a_rig_does_not_say_is_an_error(changes, message):
    with pytest.raises(SettingError, match=message):
        replace(POSE, **changes)


@pytest.mark.parametrize(
    ("columns", "episode", "message"),
    [
        ((POSE,), None, "episode is None; accepted: one of its 2, 0 to 1"),
        ((POSE,), 2, "episode is 2; accepted: one of its 2"),
        ((replace(POSE, column="state"),), 1, "no column state; it has observation.state"),
        ((replace(WRENCH, select=(0, 1, 2, 3)),), 1, "gives 4 numbers; accepted: 3 or 6 of kind"),
        ((replace(POSE, select=()),), 1, "gives 8 numbers; accepted: 7 of kind pose"),
        ((replace(POSE, select=(0, 1, 2, 3, 4, 5, 8)),), 1, "has 8 numbers, and select"),
        ((replace(JOINTS, joints=("shoulder", "wrist")),), 1, "joints wrist are not in the URDF"),
        ((replace(JOINTS, frame="hand"),), 1, "no link hand; it has base, upper, lower, tip"),
        ((replace(JOINTS, urdf="none.urdf"),), 1, "none.urdf does not exist"),
        (
            (replace(JOINTS, joints=("shoulder",), select=(0,)),),
            1,
            "joints lack elbow, which move tip",
        ),
    ],
)
def test_what_a_dataset_lacks_is_one_line(copied, columns, episode, message):
    with pytest.raises(SessionError, match=rf"^dataset .*dataset: .*{message}") as raised:
        LeRobotEpisode(copied, columns, episode=episode)
    assert str(raised.value).count("accepted: ") == 1


def test_a_column_may_say_several_things(copied):
    """The place and turn of the hand, and behind them how far its gripper is open."""
    gripper = ColumnRig("observation.state", "joints", select=(7,), joints=("gripper",), unit="m")
    episode = LeRobotEpisode(copied, (gripper, POSE), episode=0)
    contents = [one.content for one in episode.messages(["observation.state"])]
    assert contents[::2] == [{"gripper": 0.5}] * 3
    assert [content.child for content in contents[1::2]] == ["hand"] * 3
    assert episode.topics == {"observation.state": "column/TransformStamped"}


def test_a_missing_package_is_one_line(copied, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.dataset", None)
    with pytest.raises(SessionError, match=r"needs the package pyarrow.*\.\[sensors\]"):
        LeRobotEpisode(copied, (POSE,), episode=0)


def test_another_version_or_a_log_is_refused(copied, tmp_path):
    info = copied / "meta" / "info.json"
    info.write_text(info.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(SessionError, match=r"its codebase_version is v2\.1"):
        LeRobotEpisode(copied, (POSE,), episode=1)
    log = write_log(tmp_path / "log.mcap")
    with pytest.raises(SessionError, match="is no LeRobot dataset, of which rig pusher names"):
        read(log, columns=(POSE,))


def test_wrong_rows_are_left_out_and_told(copied):
    """As quaternions with w last, the numbers are those of another rotation, of length 1."""
    wrong = replace(POSE, select=(0, 1, 2, 3, 4, 4, 6))
    episode = LeRobotEpisode(copied, (wrong,), episode=1)
    assert list(episode.messages(["observation.state"])) == []
    ((text, count),) = episode.faults.items()
    assert text.startswith("observation.state: a quaternion has the length 0.707")
    assert count == 401
    assert LeRobotEpisode(copied, (POSE,), episode=0).digest() != episode.digest()


def test_columns_come_from_yaml():
    values = {
        "name": "pusher",
        "world": "world",
        "columns": [{"column": "state", "kind": "wrench", "frame": "ft", "unit": "N"}],
    }
    (column,) = build_settings(Rig, values, where="session.rig").columns
    assert (column.column, column.counts) == ("state", (3, 6))
