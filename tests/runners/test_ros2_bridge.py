"""The logic of the ROS 2 example, on messages that have the fields of ROS's."""

from types import SimpleNamespace as Message

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import chsel
from examples.ros2.chsel_touch.bridge import Bridge

# The camera is at (0, -0.5, 0), turned by -90 degrees about the world's x axis: it looks along y.
TRANSFORM = Message(
    translation=Message(x=0.0, y=-0.5, z=0.0), rotation=Message(x=-(0.5**0.5), y=0, z=0, w=0.5**0.5)
)


def test_contacts_and_depth_come_into_the_world_and_poses_out():
    asked = []
    session = chsel.Session(trimesh.creation.box((0.1, 0.06, 0.2)))
    bridge = Bridge(session, lambda header: asked.append(header) or TRANSFORM)
    for x, y, z in ((0.0, -0.02, 0.47), (0.03, 0.05, 0.47), (0.05, 0.01, 0.5), (0.01, 0.1, 0.51)):
        bridge.contact(Message(header="camera", point=Message(x=x, y=y, z=z)))
    expected = [[0.0, -0.03, 0.02], [0.03, -0.03, -0.05], [0.05, 0.0, -0.01], [0.01, 0.01, -0.1]]
    assert np.allclose(session.points.known, expected)

    depth = np.zeros((4, 6), ">u2")  # in rows of 12 bytes, of which 10 count
    depth[:, :5], depth[:, 5] = 400, 7
    image = {"width": 5, "height": 4, "step": 12, "encoding": "16UC1", "data": depth.tobytes()}
    info = Message(k=[10.0, 0.0, 2.0, 0.0, 10.0, 1.5, 0.0, 0.0, 1.0])
    bridge.look(Message(header="camera", is_bigendian=1, **image), info)
    free = session.points.free
    assert len(free) > 10
    assert -0.5 <= free[:, 1].min() < free[:, 1].max() < -0.1
    assert (np.abs(free[:, 0]) <= 0.25 * (free[:, 1] + 0.5) + 0.01).all()  # within its view

    positions, quaternions = bridge.poses()
    found = session.answer.object_from_world[~session.answer.duplicate]
    world_from_object = np.tile(np.eye(4), (len(found), 1, 1))
    world_from_object[:, :3, 3] = positions
    world_from_object[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    assert np.allclose(found @ world_from_object, np.eye(4))
    assert asked == ["camera"] * 5
