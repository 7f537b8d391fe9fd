"""A node: contacts and depth images in, plausible poses of the object out. See docs/serve.md."""

import rclpy
from geometry_msgs.msg import Point, PointStamped, Pose, PoseArray, Quaternion
from message_filters import Subscriber, TimeSynchronizer
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformException, TransformListener

import chsel
from chsel_touch.bridge import Bridge


class TouchNode(Node):
    def __init__(self):
        super().__init__("chsel_touch")
        mesh, record, self.world = (
            self.declare_parameter(name, default).value
            for name, default in (("mesh", ""), ("record", ""), ("world", "world"))
        )
        self.session = chsel.Session(mesh, record=record or None)
        self.bridge = Bridge(self.session, self.transform_to_world)
        self.seen = None
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.poses = self.create_publisher(PoseArray, "poses", 1)
        self.trust = self.create_publisher(String, "trust", 1)
        self.create_subscription(PointStamped, "contact", self.contact, 10)
        images = [Subscriber(self, Image, "depth"), Subscriber(self, CameraInfo, "camera_info")]
        self.images = TimeSynchronizer(images, 2)
        self.images.registerCallback(lambda *pair: setattr(self, "seen", pair))
        self.create_service(Trigger, "look", self.look)

    def transform_to_world(self, header):
        stamp = Time.from_msg(header.stamp)
        wait = Duration(seconds=0.5)
        return self.buffer.lookup_transform(self.world, header.frame_id, stamp, wait).transform

    def contact(self, message):
        self.update(lambda: self.bridge.contact(message))

    def look(self, _, answer):
        """Add the newest depth image."""
        answer.message = "no image yet"
        if self.seen is not None:
            answer.message = self.update(lambda: self.bridge.look(*self.seen))
        answer.success = not answer.message
        return answer

    def update(self, add):
        """Add something, publish the poses by all that is known, and say what went wrong."""
        try:
            add()
            found = zip(*self.bridge.poses(), strict=True)
        except (chsel.ChselError, TransformException) as error:
            self.get_logger().error(str(error))
            return str(error)
        message = PoseArray()
        message.header.frame_id = self.world
        message.header.stamp = self.get_clock().now().to_msg()
        for position, (x, y, z, w) in found:
            place = Point(**dict(zip("xyz", map(float, position), strict=True)))
            turn = Quaternion(x=float(x), y=float(y), z=float(z), w=float(w))
            message.poses.append(Pose(position=place, orientation=turn))
        self.poses.publish(message)
        self.trust.publish(String(data=str(self.session.trust)))
        return ""


def main():
    rclpy.init()
    node = TouchNode()
    try:  # transforms arrive while a contact waits for its own
        rclpy.spin(node, MultiThreadedExecutor())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.session.close("interrupted")
