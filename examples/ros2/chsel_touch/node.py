"""A node: contacts, wrenches and depth images in, plausible poses out. See docs/serve.md."""

import importlib

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from message_filters import Subscriber, TimeSynchronizer
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

import chsel
from chsel_touch.bridge import Bridge


class Types(dict):
    """Message classes by their names, such as std_msgs/msg/String."""

    def __missing__(self, name):
        package, _, message = name.split("/")
        self[name] = getattr(importlib.import_module(f"{package}.msg"), message)
        return self[name]


class TouchNode(Node):
    def __init__(self):
        super().__init__("chsel_touch")
        mesh, record, hand, self.world, frame = (
            self.declare_parameter(name, default).value
            for name, default in (
                ("mesh", ""),
                ("record", ""),
                ("hand", ""),
                ("world", "world"),
                ("frame", "object"),
            )
        )
        least_force = self.declare_parameter("least_force", 2.0).value
        self.session = chsel.Session(mesh, record=record or None)
        self.bridge = Bridge(
            self.session,
            self.transform_to_world,
            Types(),
            world=self.world,
            frame=frame,
            hand=chsel.load_mesh(hand) if hand else None,
            least_force=least_force,
        )
        self.seen = None
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = TransformBroadcaster(self)
        self.publishers_of = {}
        self.create_subscription(PointStamped, "contact", self.adding("contact"), 10)
        self.create_subscription(PoseStamped, "contact_normal", self.adding("contact_normal"), 10)
        if hand:
            self.create_subscription(WrenchStamped, "wrench", self.adding("wrench"), 10)
        images = [Subscriber(self, Image, "depth"), Subscriber(self, CameraInfo, "camera_info")]
        self.images = TimeSynchronizer(images, 2)
        self.images.registerCallback(lambda *pair: setattr(self, "seen", pair))
        self.create_service(Trigger, "look", self.look)

    def transform_to_world(self, header):
        stamp = Time.from_msg(header.stamp)
        wait = Duration(seconds=0.5)
        return self.buffer.lookup_transform(self.world, header.frame_id, stamp, wait).transform

    def adding(self, name):
        """Return what takes a message of a topic."""
        return lambda message: self.update(lambda: getattr(self.bridge, name)(message))

    def look(self, _, answer):
        """Add the newest depth image."""
        answer.message = "no image yet"
        if self.seen is not None:
            answer.message = self.update(lambda: self.bridge.look(*self.seen))
        answer.success = not answer.message
        return answer

    def update(self, add):
        """Add something, publish what is found by all that is known, and say what went wrong."""
        try:
            if add() is False:  # nothing new
                return ""
            found = self.bridge.results(self.get_clock().now().to_msg())
        except (chsel.ChselError, TransformException) as error:
            self.get_logger().error(str(error))
            return str(error)
        for topic, message in found:
            if topic == "tf":
                self.broadcaster.sendTransform(message)
                continue
            if topic not in self.publishers_of:
                self.publishers_of[topic] = self.create_publisher(type(message), topic, 1)
            self.publishers_of[topic].publish(message)
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
