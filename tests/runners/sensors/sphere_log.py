"""A log of a made-up robot that presses a bubble pad onto a sphere while a camera looks on."""

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, inverse
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.rig import BoxRig, BubbleRig, CameraRig, ContactRig, HandRig, Rig
from runners.simulated_robot.log_writer import LogWriter, camera_info, image, joint_state, transform
from tests.runners.sensors.small_logs import BEGIN, SECOND, ros2_cloud

LATENCY = 4_000_000  # ns from a stamp to its log time

CENTRE = np.array([0.9, 0.0, 0.45])
RADIUS = 0.04
WALL = 1.08  # m: x of a wall behind the sphere
MEMBRANE = 0.06  # m: from the pad's camera to its untouched membrane, a plane
PRESSED = 0.012  # m: how far the membrane's plane reaches into the sphere at the end of a push
ASIDE = 0.12  # m: by which the second probe passes the sphere

OUTER = PinholeCamera(96, 72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
INNER = PinholeCamera(48, 36, fx=50.0, fy=50.0, cx=23.5, cy=17.5)

# The hand's z axis, and so that of the pad's camera, is the world's x axis.
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
HAND_FROM_PAD = compose(np.eye(3), np.array([0.0, 0.0, 0.1]))
WORLD_FROM_CAMERA = compose(
    np.array([[0.6, 0.0, 0.8], [-0.8, 0.0, 0.6], [0.0, -1.0, 0.0]]), np.array([0.54, -0.27, 0.45])
)
LIDAR = np.array([0.72, 0.1, 0.55])  # m: its place in the world

RIG = Rig(
    name="sphere",
    world="world",
    workspace=((0.7, 1.1), (-0.2, 0.2), (0.3, 0.6)),
    cameras=(
        CameraRig(
            "camera",
            "/camera/depth",
            info="/camera/info",
            range=(0.1, 2.0),
            rate=None,
            edge_reach=1,
        ),
    ),
    bubbles=(BubbleRig("pad", "/pad/depth", info="/pad/info", range=(0.01, 0.1)),),
    contact=ContactRig(filter=3, points=50),
    hand=HandRig("hand", boxes=(BoxRig((0.04, 0.06, 0.08), (0.0, 0.0, 0.04)),)),
    markers="/probe",
)
MARKS = ((0.95, "begin 0"), (2.95, "end 0"), (3.05, "begin 1"), (4.95, "end 1"))


@dataclass(frozen=True, eq=False)
class SphereLog:
    """How the log is written. marks: times in seconds and texts of the markers.

    unit: metres of a unit of the camera's images. camera_clock: seconds by which it is ahead, from
    camera_clock_set on. info: what its camera info has otherwise. camera_frame: its pose (4, 4).
    lost_transforms: seconds between which the hand sends none. left_out: topics without messages.
    finger: metres at which a joint of this name stands; None: no joint states. cloud: points
    (N, 3) in the lidar's frame, sent on /lidar and /skin before and in the first probe, with
    normals (N, 3), if there are any.
    """

    marks: tuple[tuple[float, str], ...] = MARKS
    unit: float = 0.001
    camera_clock: float = 0.0
    camera_clock_set: float = 0.0
    info: tuple[tuple[str, object], ...] = ()
    camera_frame: FloatArray | None = None
    lost_transforms: tuple[float, float] = (0.0, 0.0)
    left_out: tuple[str, ...] = ()
    finger: float | None = None
    cloud: tuple[tuple[float, float, float], ...] = ()
    normals: FloatArray | None = None

    def write(self, path):
        """Five seconds: standing, a push onto the sphere, and one that passes it."""
        with LogWriter(path) as writer:
            for tick in range(101):
                self._send(writer, tick)
            for seconds, text in self.marks:
                self._add(
                    writer,
                    "/probe",
                    kind="std_msgs/String",
                    message={"data": text},
                    sent=time_of(seconds),
                )
        return path

    def _send(self, writer, tick):
        seconds = tick * 0.05
        stamp, hand = time_of(seconds), hand_pose(seconds)
        lost, found = self.lost_transforms
        if not lost <= seconds < found:
            moving = {
                "transforms": [transform("world", "hand", parent_from_child=hand, stamp=stamp)]
            }
            self._add(writer, "/tf", kind="tf2_msgs/TFMessage", message=moving, sent=stamp)
        if self.finger is not None:
            joints = joint_state(["elbow", "finger"], [seconds, self.finger], stamp=stamp)
            self._add(
                writer, "/joint_states", kind="sensor_msgs/JointState", message=joints, sent=stamp
            )
        if tick == 0:
            camera = WORLD_FROM_CAMERA if self.camera_frame is None else self.camera_frame
            fixed = [
                transform("hand", "pad_frame", parent_from_child=HAND_FROM_PAD, stamp=stamp),
                transform("world", "camera_frame", parent_from_child=camera, stamp=stamp),
                transform(
                    "world", "lidar", parent_from_child=compose(np.eye(3), LIDAR), stamp=stamp
                ),
            ]
            self._add(
                writer,
                "/tf_static",
                kind="tf2_msgs/TFMessage",
                message={"transforms": fixed},
                sent=stamp,
            )
        images = []
        if tick % 2 == 0:
            images.append(("pad", INNER, membrane(hand).astype(np.float32), stamp))
        if tick % 10 == 0:
            is_ahead = seconds >= self.camera_clock_set
            ahead = stamp + round(is_ahead * self.camera_clock * SECOND)
            images.append(("camera", OUTER, np.rint(seen() / self.unit).astype(np.uint16), ahead))
        for name, camera, values, seen_at in images:
            info = camera_info(f"{name}_frame", camera, stamp=seen_at)
            if name == "camera":
                info |= dict(self.info)
            self._add(
                writer, f"/{name}/info", kind="sensor_msgs/CameraInfo", message=info, sent=stamp
            )
            depth = image(f"{name}_frame", values, stamp=seen_at)
            self._add(writer, f"/{name}/depth", kind="sensor_msgs/Image", message=depth, sent=stamp)
        if self.cloud and tick in (10, 40):
            cloud = ros2_cloud(np.array(self.cloud), stamp, normals=self.normals)
            for topic in ("/lidar", "/skin"):
                self._add(writer, topic, kind="sensor_msgs/PointCloud2", message=cloud, sent=stamp)

    def _add(self, writer, topic, *, kind, message, sent):
        if topic not in self.left_out:
            writer.add(topic, kind, message=message, stamp=sent, log_time=sent + LATENCY)


def time_of(seconds):
    """Nanoseconds."""
    return BEGIN + round(seconds * SECOND)


def hand_pose(seconds):
    """Pose (4, 4) of the hand in the world: two pushes of two seconds, the second one aside."""
    push, within = divmod(seconds - 1.0, 2.0)
    travel = 1.0 - abs(within - 1.0) if push >= 0 else 0.0
    furthest = CENTRE[0] - RADIUS + PRESSED - MEMBRANE - HAND_FROM_PAD[2, 3]
    x = furthest - 0.1 * (1.0 - travel)
    return compose(FORWARD, np.array([x, ASIDE * (push >= 1), CENTRE[2]]))


def membrane(hand):
    """Depth (H, W) in the pad: the untouched plane, or the sphere where it is nearer."""
    return np.minimum(MEMBRANE, _to_sphere(INNER, hand @ HAND_FROM_PAD))


def seen():
    """Depth (H, W) in the camera: the sphere, or the wall behind it."""
    ways = OUTER.directions() @ WORLD_FROM_CAMERA[:3, :3].T
    to_wall = (WALL - WORLD_FROM_CAMERA[0, 3]) / ways[..., 0]
    return np.minimum(to_wall, _to_sphere(OUTER, WORLD_FROM_CAMERA))


def heights(points):
    """Signed distance (N,) of points (N, 3) to the sphere."""
    return np.sqrt(((points - CENTRE) ** 2).sum(axis=1)) - RADIUS


def _to_sphere(camera, world_from_camera):
    """Depth (H, W) at which rays meet the sphere, infinite if they do not."""
    ways = camera.directions()
    centre = inverse(world_from_camera)[:3] @ [*CENTRE, 1.0]
    a, b = (ways**2).sum(axis=-1), ways @ centre
    root = b**2 - a * (centre @ centre - RADIUS**2)
    return np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
