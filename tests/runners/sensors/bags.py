"""Logs in MCAP as the package rosbags writes them into bags of rosbag2 and of ROS 1."""

from mcap.reader import make_reader
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
ROS1.register(get_types_from_msg(TRANSFORMS, "tf2_msgs/msg/TFMessage"))
ROS1.register(get_types_from_msg(TRANSFORMS, "tf/msg/tfMessage"))


def write_rosbag2(mcap, folder):
    """A folder with metadata.yaml and a file in sqlite3, with the messages of an MCAP file."""
    with rosbag2.Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for topic, kind, data, time in _messages(mcap):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], time, data)
    return next(folder.glob("*.db3"))


def write_ros1(mcap, path):
    """A bag of ROS 1 with the messages of an MCAP file."""
    with rosbag1.Writer(path) as writer:
        connections = {}
        for topic, kind, data, time in _messages(mcap):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            # Headers of ROS 1 have a number besides, which this conversion adds.
            writer.write(connections[topic], time, ROS2.cdr_to_ros1(data, kind))
    return path


def _messages(mcap):
    with mcap.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            yield channel.topic, schema.name, message.data, message.log_time
