"""The logic of the ROS 2 example on real messages, by the types and the serialisation of rosbags.

ROS itself is in none of the package registries, so the node runs on stand-ins for its classes.
"""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import trimesh
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import chsel
from chsel.errors import SettingError
from examples.ros2.chsel_touch.bridge import Bridge

STORE = get_typestore(Stores.ROS2_JAZZY)
BOX = trimesh.creation.box((0.1, 0.06, 0.2))
BOX.apply_translation([0.0, 0.0, 0.1])  # so that the origin of its frame is not its centre
FINGER = trimesh.creation.box(bounds=[[-0.01, -0.01, -0.06], [0.01, 0.01, 0.0]])
# The camera is at (0, -0.5, 0), turned by -90 degrees about the world's x axis: it looks along y.
CAMERA = ((0.0, -0.5, 0.0), (-(0.5**0.5), 0.0, 0.0, 0.5**0.5))


def make(name, **fields):
    """A message as it comes from another process."""
    kind = {"Header": "std_msgs", "Time": "builtin_interfaces"}.get(name, "geometry_msgs")
    name = f"{kind}/msg/{name}"
    return sent(name, STORE.types[name](**fields))


def sent(name, message):
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def header(frame):
    return make("Header", stamp=make("Time", sec=3, nanosec=5), frame_id=frame)


def vector(kind, place):
    return make(kind, **dict(zip("xyz", map(float, place), strict=True)))


def transform(place, quaternion):
    turn = dict(zip("xyzw", quaternion, strict=True))
    return make(
        "Transform", translation=vector("Vector3", place), rotation=make("Quaternion", **turn)
    )


def bridge_of(session, transforms, **options):
    frames = {"camera": transform(*CAMERA), **transforms}
    return Bridge(session, lambda one: frames[one.frame_id], STORE.types, **options)


def results(bridge):
    """What is published, sent to another process."""
    stamp = make("Time", sec=7, nanosec=0)
    return {topic: sent(one.__msgtype__, one) for topic, one in bridge.results(stamp)}


def matrix(pose):
    place, turn = pose.position, pose.orientation
    found = np.eye(4)
    found[:3, 3] = place.x, place.y, place.z
    found[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    return found


def contact(place):
    return make("PointStamped", header=header("camera"), point=vector("Point", place))


IN_CAMERA = ((0.0, -0.02, 0.47), (0.03, 0.05, 0.47), (0.05, 0.01, 0.5), (0.01, 0.1, 0.51))
IN_WORLD = [[0.0, -0.03, 0.02], [0.03, -0.03, -0.05], [0.05, 0.0, -0.01], [0.01, 0.01, -0.1]]


def test_contacts_and_depth_come_into_the_world_and_poses_out():
    session = chsel.Session(BOX)
    bridge = bridge_of(session, {})
    for place in IN_CAMERA:
        bridge.contact(contact(place))
    assert np.allclose(session.points.known, IN_WORLD)
    depth = np.zeros((4, 6), ">u2")  # in rows of 12 bytes, of which 10 count
    depth[:, :5], depth[:, 5] = 400, 7
    image = STORE.types["sensor_msgs/msg/Image"](
        header=header("camera"),
        height=4,
        width=5,
        encoding="16UC1",
        is_bigendian=1,
        step=12,
        data=np.frombuffer(depth.tobytes(), np.uint8),
    )
    info = SimpleNamespace(k=[10.0, 0.0, 2.0, 0.0, 10.0, 1.5, 0.0, 0.0, 1.0])
    bridge.look(sent("sensor_msgs/msg/Image", image), info)
    free = session.points.free
    assert len(free) > 10
    assert -0.5 <= free[:, 1].min() < free[:, 1].max() < -0.1
    assert (np.abs(free[:, 0]) <= 0.25 * (free[:, 1] + 0.5) + 0.01).all()  # within its view
    published = results(bridge)
    found = session.answer.object_from_world[~session.answer.duplicate]
    poses = np.array([matrix(pose) for pose in published["poses"].poses])
    assert np.allclose(found @ poses, np.eye(4))
    assert published["poses"].header.frame_id == "world"
    assert published["verdict"].data == "wide"
    assert published["trust"].data == str(session.trust)
    assert not [topic for topic in published if topic.startswith("mode_")]


def test_a_contact_has_a_normal_along_the_z_axis_of_its_pose():
    session = chsel.Session(BOX)
    bridge = bridge_of(session, {})
    quarter = make("Quaternion", x=0.0, y=0.5**0.5, z=0.0, w=0.5**0.5)  # z to the camera's x
    pose = make("Pose", position=vector("Point", IN_CAMERA[2]), orientation=quarter)
    bridge.contact_normal(make("PoseStamped", header=header("camera"), pose=pose), noise=0.1)
    assert np.allclose(session.points.known, IN_WORLD[2:3])
    assert np.allclose(session.points.normals, [[1.0, 0.0, 0.0]])
    assert session.points.normal_noise == [0.1]


def wrench(force, at):
    """On the finger, in its frame, of a force at a place."""
    both = make(
        "Wrench",
        force=vector("Vector3", force),
        torque=vector("Vector3", np.cross(at, force)),
    )
    return make("WrenchStamped", header=header("hand"), wrench=both)


def test_a_wrench_is_a_contact_once_a_touch():
    half_turn = ((0.2, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0))  # about x: the finger points down
    session = chsel.Session(BOX)
    bridge = bridge_of(session, {"hand": transform(*half_turn)}, hand=FINGER)
    at = np.array([0.004, -0.003, 0.0])  # of its tip
    assert not bridge.wrench(wrench([0.0, 0.0, -0.5], at))
    assert bridge.wrench(wrench([0.0, 0.0, -4.0], at))
    assert not bridge.wrench(wrench([0.0, 0.0, -5.0], at))
    assert not bridge.wrench(wrench([0.0, 0.0, -0.1], at))
    assert np.allclose(session.points.known, [[0.204, 0.003, 0.3]])
    assert np.allclose(session.points.normals, [[0.0, 0.0, 1.0]])  # of a floor, say
    assert len(session.points.free) > 5  # where the finger is
    assert bridge.wrench(wrench([0.0, 3.0, 0.0], np.array([0.0, -0.01, -0.02])))
    assert np.allclose(session.points.known[1], [0.2, 0.01, 0.32])
    with pytest.raises(SettingError, match="hand is missing"):
        bridge_of(session, {}).wrench(wrench([0.0, 0.0, -4.0], at))


def test_modes_have_covariances_and_weights_and_the_pose_does_not_jump():
    """A box that is touched all over looks as it does after half turns: one mode, one pose."""
    session = chsel.Session(BOX)
    bridge = bridge_of(session, {}, frame="box")
    places = trimesh.sample.sample_surface(BOX, 40, seed=0)[0]
    before = None
    for first in (0, 20):
        session.add(contacts=places[first : first + 20])
        published = results(bridge)
        (mode,) = session.belief.modes
        stamped = published[f"mode_{mode.number}"]
        assert stamped.header.stamp.sec == 7
        assert np.allclose(matrix(stamped.pose.pose), mode.world_from_object)
        covariance = stamped.pose.covariance.reshape(6, 6)
        assert np.allclose(covariance, mode.pose_covariance)
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()
        assert published[f"mode_{mode.number}/weight"].data == mode.weight
        moved = published["tf"]
        assert (moved.header.frame_id, moved.child_frame_id) == ("world", "box")
        place = moved.transform.translation
        turn = moved.transform.rotation
        pose = matrix(SimpleNamespace(position=place, orientation=turn))
        assert np.allclose(pose, session.pose, atol=1e-9)
        assert before is None or np.abs(pose - before).max() < 0.02
        before = pose
    bridge._published.add(7)
    assert results(bridge)["mode_7/weight"].data == 0.0  # one that is no more


def test_the_node_publishes_what_the_bridge_returns(monkeypatch, tmp_path):
    """By stand-ins for the classes of ROS, with its message types."""
    taken = {}
    published = []

    class Node:
        def __init__(self, name):
            self.name = name

        def declare_parameter(self, name, default):
            given = {"mesh": str(tmp_path / "box.ply"), "hand": str(tmp_path / "finger.ply")}
            return SimpleNamespace(value=given.get(name, default))

        def create_subscription(self, kind, topic, callback, _):
            taken[topic] = callback

        def create_publisher(self, kind, topic, _):
            return SimpleNamespace(publish=lambda one: published.append((topic, kind, one)))

        def create_service(self, kind, name, callback):
            taken[name] = callback

        def get_clock(self):
            now = SimpleNamespace(to_msg=lambda: make("Time", sec=1, nanosec=0))
            return SimpleNamespace(now=lambda: now)

        def get_logger(self):
            return SimpleNamespace(error=lambda text: published.append(("error", str, text)))

    def lookup(*_):
        return SimpleNamespace(transform=transform(*CAMERA))

    parts = {
        "rclpy": {},
        "rclpy.duration": {"Duration": SimpleNamespace},
        "rclpy.executors": {"ExternalShutdownException": OSError, "MultiThreadedExecutor": None},
        "rclpy.node": {"Node": Node},
        "rclpy.time": {"Time": SimpleNamespace(from_msg=lambda one: one)},
        "message_filters": {
            "Subscriber": lambda *_: None,
            "TimeSynchronizer": lambda *_: SimpleNamespace(registerCallback=lambda _: None),
        },
        "std_srvs.srv": {"Trigger": None},
        "tf2_ros": {
            "Buffer": lambda: SimpleNamespace(lookup_transform=lookup),
            "TransformBroadcaster": lambda _: SimpleNamespace(
                sendTransform=lambda one: published.append(("tf", type(one), one))
            ),
            "TransformException": OSError,
            "TransformListener": lambda *_: None,
        },
    }
    for package in ("geometry_msgs", "sensor_msgs", "std_msgs"):
        prefix = f"{package}/msg/"
        kinds = {n.removeprefix(prefix): k for n, k in STORE.types.items() if n.startswith(prefix)}
        parts[f"{package}.msg"] = kinds
    parts["chsel_touch.bridge"] = {"Bridge": Bridge}
    for name, content in parts.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        package = name.partition(".")[0]
        if package != name and package not in parts:
            monkeypatch.setitem(sys.modules, package, ModuleType(package))
    BOX.export(tmp_path / "box.ply")
    FINGER.export(tmp_path / "finger.ply")
    node = importlib.import_module("examples.ros2.chsel_touch.node").TouchNode()
    for place in IN_CAMERA:
        taken["contact"](contact(place))
    topics = [topic for topic, *_ in published]
    assert topics.count("poses") == 4
    assert {"trust", "verdict", "tf"} <= set(topics)
    assert all(kind is type(one) for topic, kind, one in published)
    assert np.allclose(node.session.points.known, IN_WORLD)
    taken["wrench"](wrench([0.0, 0.0, -0.5], np.zeros(3)))  # too weak
    assert len(published) == len(topics)
    answer = taken["look"](None, SimpleNamespace(message="", success=True))
    assert (answer.success, answer.message) == (False, "no image yet")
    taken["contact"](contact((np.nan, 0.0, 0.0)))
    assert published[-1][0] == "error"
