"""A log of ROS 2 said again in Foxglove's messages."""

from importlib import import_module

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from tests.runners.sensors.small_logs import png


def in_foxgloves_messages(source, target, *, packed):
    """Write the messages of one log into another, at the same times on the same topics.

    Those without a counterpart are left out.

    packed: 16-bit images are PNG, each transform is a message of its own, and markers are pairs of
    key and value; otherwise images are rows, transforms come together, and markers are log lines.
    Quaternions are taken as they stand in the log: by way of matrices they would be rounded.
    """
    with source.open("rb") as read, target.open("wb") as written:
        writer = Writer(written)
        writer.start()
        channels: dict[str, int] = {}
        messages = make_reader(read, decoder_factories=[DecoderFactory()])
        for kind, channel, message, said in messages.iter_decoded_messages():
            for again in _said_again(kind.name.split("/")[-1], said, packed=packed):
                if channel.topic not in channels:
                    name = again.DESCRIPTOR.full_name
                    schema = writer.register_schema(name, "protobuf", b"of no matter")
                    number = writer.register_channel(channel.topic, "protobuf", schema)
                    channels[channel.topic] = number
                time = message.log_time
                writer.add_message(channels[channel.topic], time, again.SerializeToString(), time)
        writer.finish()
    return target


def _made(kind, said=None, **fields):
    """A message of Foxglove's with the head of one of ROS 2."""
    if said is not None:
        stamp = said.header.stamp
        fields |= {"timestamp": {"seconds": stamp.sec, "nanos": stamp.nanosec}}
        fields |= {"frame_id": said.header.frame_id}
    made = getattr(import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind)
    known = made.DESCRIPTOR.fields_by_name
    return made(**{name: value for name, value in fields.items() if name in known})


def _said_again(kind, said, *, packed):
    match kind:
        case "TFMessage":
            moved = [_transform(one) for one in said.transforms]
            yield from moved if packed else [_made("FrameTransforms", transforms=moved)]
        case "Image" if packed and said.encoding == "16UC1":
            values = np.frombuffer(said.data, "<u2").reshape(said.height, -1)[:, : said.width]
            yield _made("CompressedImage", said, format="png", data=png(values))
        case "Image":
            size = {"width": said.width, "height": said.height, "step": said.step}
            yield _made("RawImage", said, encoding=said.encoding, data=bytes(said.data), **size)
        case "CameraInfo":
            size = {"width": said.width, "height": said.height}
            matrices = {"K": list(said.k), "D": list(said.d), "P": list(said.p)}
            yield _made("CameraCalibration", said, **matrices, **size)
        case "JointState":
            pairs = zip(said.name, said.position, strict=True)
            joints = [_made("JointState", name=name, position=value) for name, value in pairs]
            yield _made("JointStates", said, joints=joints)
        case "String" if packed:
            key, _, value = said.data.partition(" ")
            yield _made("KeyValuePair", key=key, value=value)
        case "String":
            yield _made("Log", message=said.data)
        case "CompressedImage" if said.format == "png":
            yield _made("CompressedImage", said, format="png", data=bytes(said.data))
        case "PoseStamped":
            yield _made("PoseInFrame", said, pose=_pose(said.pose))
        case "PoseArray":
            yield _made("PosesInFrame", said, poses=[_pose(one) for one in said.poses])
        case "PointStamped":
            yield _made("Point3InFrame", said, point=_xyz(said.point))
        case "PointCloud2":
            numbers = np.frombuffer(said.data).reshape(said.width, -1, 3)  # points, and normals
            fields = [{"name": f.name, "offset": f.offset, "type": 8} for f in said.fields]
            pose = {"position": {"x": 1.0}, "orientation": {"z": 2.0, "w": 2.0}}  # 90 degrees
            local = numbers.copy()
            local[:, 0] -= [1.0, 0.0, 0.0]
            data = (local @ [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).tobytes()
            yield _made(
                "PointCloud",
                said,
                pose=pose,
                point_stride=said.point_step,
                fields=fields,
                data=data,
            )


def _xyz(one):
    return {name: getattr(one, name) for name in "xyzw" if hasattr(one, name)}


def _pose(one):
    return {"position": _xyz(one.position), "orientation": _xyz(one.orientation)}


def _transform(one):
    return _made(
        "FrameTransform",
        one,
        parent_frame_id=one.header.frame_id,
        child_frame_id=one.child_frame_id,
        translation=_xyz(one.transform.translation),
        rotation=_xyz(one.transform.rotation),
    )
