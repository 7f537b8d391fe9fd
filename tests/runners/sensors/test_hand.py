"""The shape of a hand from boxes, meshes and URDF files."""

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from runners.sensors.hand import HandModel
from runners.sensors.rig import BoxRig, HandRig

GRIPPER = """<?xml version="1.0"?>
<robot name="gripper">
  <link name="arm"><collision><geometry><sphere radius="0.5"/></geometry></collision></link>
  <joint name="wrist" type="revolute">
    <parent link="arm"/><child link="palm"/><axis xyz="0 0 1"/><origin xyz="0 0 1"/>
  </joint>
  <link name="palm">
    <collision><origin xyz="0 0 0.05"/><geometry><box size="0.04 0.2 0.1"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="palm"/><child link="left"/><axis xyz="0 2 0"/><origin xyz="0 0 0.1"/>
  </joint>
  <link name="left">
    <collision><geometry><cylinder radius="0.01" length="0.06"/></geometry></collision>
  </link>
  <joint name="follow" type="prismatic">
    <parent link="palm"/><child link="right"/><axis xyz="0 -1 0"/><origin xyz="0 0 0.1"/>
    <mimic joint="slide" multiplier="2" offset="0.01"/>
  </joint>
  <link name="right">
    <collision><geometry><cylinder radius="0.01" length="0.06"/></geometry></collision>
  </link>
  <joint name="bend" type="continuous">
    <parent link="right"/><child link="tip"/><axis xyz="1 0 0"/>
    <origin rpy="0 0 1.5707963267948966"/>
  </joint>
  <link name="tip">
    <collision>
      <origin xyz="0.03 0 0"/><geometry><sphere radius="0.005"/></geometry>
    </collision>
  </link>
</robot>
"""


def urdf(folder, text=GRIPPER):
    path = folder / "gripper.urdf"
    path.write_text(text)
    return str(path)


def one_link(folder, geometry):
    shape = f"<collision><geometry>{geometry}</geometry></collision>"
    return urdf(folder, f'<robot name="r"><link name="a">{shape}</link></robot>')


def hand(path, root=None):
    return HandRig(frame="hand", urdf=path, root=root)


def test_boxes_stand_where_the_rig_puts_them():
    turned = (np.pi / 2, 0.0, np.pi / 2)
    boxes = BoxRig((0.1, 0.2, 0.3), (1.0, 0.0, 0.0)), BoxRig((0.1, 0.2, 0.3), rotation=turned)
    solids = HandModel(HandRig(frame="hand", boxes=boxes)).solids()
    assert solids.is_watertight
    assert solids.volume == pytest.approx(2 * 0.006)
    upright, lying = solids.split()
    np.testing.assert_allclose(upright.bounds, [[0.95, -0.1, -0.15], [1.05, 0.1, 0.15]])
    # First about x: y and z change places; then about z: x and y do.
    np.testing.assert_allclose(lying.extents, [0.3, 0.1, 0.2], atol=1e-12)


@pytest.mark.parametrize("arm", ["revolute", "planar"])
def test_joints_place_the_links(tmp_path, arm):
    """arm: what its joint is, whose values do not matter to the hand."""
    joints = {"slide": 0.02, "bend": 0.4, "elbow": 7.0, "wrist": 9.0}
    model = HandModel(hand(urdf(tmp_path, GRIPPER.replace("revolute", arm)), "palm"))
    palm, left, right, tip = model.parts(joints)
    assert model.joint_names == ("slide", "bend")
    assert list(model.warnings) == []
    np.testing.assert_allclose(palm.bounds, [[-0.02, -0.1, 0.0], [0.02, 0.1, 0.1]])
    np.testing.assert_allclose(left.bounds.mean(axis=0), [0.0, 0.02, 0.1], atol=1e-12)
    # The mimic goes to 2 x 0.02 + 0.01 along -y; a tip turned by 90 degrees about z points there.
    np.testing.assert_allclose(right.bounds.mean(axis=0), [0.0, -0.05, 0.1], atol=1e-12)
    np.testing.assert_allclose(tip.bounds.mean(axis=0), [0.0, -0.02, 0.1], atol=1e-12)
    assert all(part.is_watertight and part.volume > 0.0 for part in model.parts(joints))
    turning = GRIPPER.replace('<axis xyz="1 0 0"/>', '<axis xyz="0 0 2"/>')
    _, tip = HandModel(hand(urdf(tmp_path, turning), "right")).parts({"bend": np.pi / 2})
    # 90 degrees of the origin and 90 of the joint turn x into -x.
    np.testing.assert_allclose(tip.bounds.mean(axis=0), [-0.03, 0.0, 0.0], atol=1e-9)


def test_the_base_is_the_root_unless_another_is_named(tmp_path):
    whole = HandModel(hand(urdf(tmp_path)))
    assert len(whole.parts()) == 5
    assert whole.joint_names == ("wrist", "slide", "bend")
    np.testing.assert_allclose(whole.parts()[1].bounds[:, 2], [1.0, 1.1])


def test_meshes_are_found_beside_the_urdf_and_in_its_packages(tmp_path):
    package = tmp_path / "gripper_description"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    trimesh.creation.box((10.0, 20.0, 30.0)).export(package / "meshes" / "palm.stl")
    for name in ("../meshes/palm.stl", "package://gripper_description/meshes/palm.stl"):
        path = one_link(package / "urdf", f'<mesh filename="{name}" scale="0.001 0.001 -0.002"/>')
        model = HandModel(hand(path))
        assert list(model.warnings) == []
        (palm,) = model.parts()
        np.testing.assert_allclose(palm.extents, [0.01, 0.02, 0.06])
        assert palm.volume == pytest.approx(12e-6)  # mirrored, and still turned outward
    path = one_link(package / "urdf", '<mesh filename="package://other/palm.stl"/>')
    with pytest.raises(SettingError, match=r"mesh package://other/palm.stl does not exist in or"):
        HandModel(hand(path))
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.stl")
    model = HandModel(hand(one_link(tmp_path, '<mesh filename="open.stl"/>')))
    (solid,) = model.parts()
    assert (solid.is_watertight, solid.volume) == (True, pytest.approx(1e-3))
    assert "a mesh of link a is open; its convex hull is used" in "".join(model.warnings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "cannot be read"),
        ('<robot name="r"><link name="a"/></robot>', "no collision shape at or below link a"),
        ('<robot name="r" xmlns:xacro="x"><xacro:arm/></robot>', "holds xacro macros"),
        (GRIPPER.replace('child link="tip"', 'child link="left"'), "a tree of links"),
        (GRIPPER.replace('mimic joint="slide"', 'mimic joint="follow"'), "follow mimics follow"),
    ],
)
def test_unusable_files_are_refused_in_a_line(tmp_path, text, message):
    with pytest.raises(SettingError, match=message) as caught:
        HandModel(hand(urdf(tmp_path, text)))
    assert f"hand.urdf {tmp_path}" in str(caught.value)
    assert "\n" not in str(caught.value)
