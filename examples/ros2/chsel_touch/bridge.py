"""From ROS messages to a session and back, without an import of ROS."""

import numpy as np

from chsel.errors import SettingError
from chsel.problem.poses import apply, inverse, quaternions, rotated
from chsel.sensing.contact_sensing import contact_on_axis
from runners.sensors.log.decoding import rigid
from runners.sensors.log.images import pixel_rows

NORMAL_NOISE = 0.35  # radians, of normals by a wrench: those of the hand where it is touched


class Bridge:
    """Feeds a session, and says what it found.

    transform_to_world(header) is a geometry_msgs/Transform. types[NAME] makes messages of the type
    NAME, such as "geometry_msgs/msg/Pose". world, frame: of the pose that is broadcast. hand: its
    mesh in the frame of its wrenches. least_force: newtons that are a touch.
    """

    def __init__(
        self,
        session,
        transform_to_world,
        types,
        *,
        world="world",
        frame="object",
        hand=None,
        least_force=2.0,
    ):
        self.session = session
        self._transform = transform_to_world
        self._types = types
        self._world = world
        self._frame = frame
        self._hand = hand
        self._least_force = least_force
        self._is_touching = False
        self._published = set()  # numbers of modes

    def contact(self, message):
        """Add a geometry_msgs/PointStamped, metres."""
        self.session.add(contacts=self._in_world(message.header, message.point))

    def contact_normal(self, message, noise=0.25):
        """Add a geometry_msgs/PoseStamped: a contact whose z axis points out of the object."""
        pose = message.pose
        turn = self._world_from(message.header)[:3, :3]
        normal = turn @ rigid(pose.position, pose.orientation)[:3, 2]
        places = self._in_world(message.header, pose.position)
        self.session.add(contacts=places, normals=normal[None], normal_noise=noise)

    def wrench(self, message):
        """Add where a geometry_msgs/WrenchStamped says that the hand is touched, once a touch.

        Gravity and offset are taken out of it before. Return whether something was added.
        """
        if self._hand is None:
            raise SettingError("hand is missing; accepted: a mesh, with wrenches")
        force = _vector(message.wrench.force)
        is_touching = bool(np.linalg.norm(force) >= self._least_force)
        if self._is_touching or not is_touching:
            self._is_touching = is_touching
            return False
        torque = _vector(message.wrench.torque)
        found = contact_on_axis(force, torque, triangles=np.asarray(self._hand.triangles))
        world_from_hand = self._world_from(message.header)
        self.session.add(
            hand=self._hand,
            path=world_from_hand[None],
            contact=apply(world_from_hand, found.point[None])[0],
            normal=rotated(world_from_hand[:3, :3], -found.normal[None])[0],
            normal_noise=NORMAL_NOISE,
        )
        self._is_touching = True
        return True

    def look(self, image, info):
        """Add the free space of a sensor_msgs/Image: 32FC1 in metres, or 16UC1 in millimetres."""
        size = image.width, image.height
        data, order = bytes(image.data), bool(image.is_bigendian)
        values = pixel_rows(data, image.encoding, size=size, step=image.step, big_endian=order)
        self.session.add(
            depth=values * (0.001 if values.dtype == np.uint16 else 1.0),
            camera=np.reshape(info.k, (3, 3)),
            world_from_camera=self._world_from(image.header),
        )

    def results(self, stamp):
        """Register, and return what is published: topics with their messages; stamp: the time.

        A result that is wide has no modes: its poses are particles of equal weight.
        """
        found = self.session.register()
        header = self._make("std_msgs/msg/Header", stamp=stamp, frame_id=self._world)
        particles = [self._pose(one) for one in inverse(found.object_from_world[~found.duplicate])]
        poses = self._make("geometry_msgs/msg/PoseArray", header=header, poses=particles)
        trust = found.trust
        verdict = "" if trust is None else trust.verdict
        messages = [("poses", poses), ("trust", self._text(str(trust)))]
        messages.append(("verdict", self._text(verdict)))
        modes = [] if trust is None else self.session.belief.modes
        for mode in modes:
            pose = self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(mode.world_from_object),
                covariance=mode.pose_covariance.ravel(),
            )
            stamped = self._make(
                "geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=pose
            )
            messages.append((f"mode_{mode.number}", stamped))
            messages.append((f"mode_{mode.number}/weight", self._number(mode.weight)))
        for gone in sorted(self._published - {mode.number for mode in modes}):
            messages.append((f"mode_{gone}/weight", self._number(0.0)))
        self._published |= {mode.number for mode in modes}
        if self.session.pose is not None and verdict != "nothing fits":
            messages.append(("tf", self._transform_of(self.session.pose, header)))
        return messages

    def _transform_of(self, world_from_object, header):
        pose = self._pose(world_from_object)
        place = pose.position
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=self._frame,
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._make(
                    "geometry_msgs/msg/Vector3", x=place.x, y=place.y, z=place.z
                ),
                rotation=pose.orientation,
            ),
        )

    def _pose(self, transform):
        x, y, z, w = (float(one) for one in quaternions(transform[None, :3, :3])[0])
        place = dict(zip("xyz", transform[:3, 3].tolist(), strict=True))
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", **place),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def _text(self, text):
        return self._make("std_msgs/msg/String", data=text)

    def _number(self, number):
        return self._make("std_msgs/msg/Float64", data=float(number))

    def _make(self, name, **fields):
        return self._types[name](**fields)

    def _in_world(self, header, point):
        return apply(self._world_from(header), _vector(point)[None])

    def _world_from(self, header):
        transform = self._transform(header)
        return rigid(transform.translation, transform.rotation)


def _vector(message):
    return np.array([message.x, message.y, message.z])
