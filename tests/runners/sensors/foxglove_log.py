"""A log of ROS 2 said again in Foxglove's messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from runners.sensors.log.decoding import packed_points
from tests.runners.sensors.small_logs import png


def in_foxgloves_messages(source: Path, target: Path, *, packed: bool) -> Path:
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
            assert kind is not None
            for again in _said_again(kind.name, said, packed):
                if channel.topic not in channels:
                    name = again.DESCRIPTOR.full_name
                    schema = writer.register_schema(name, "protobuf", b"of no matter")
                    number = writer.register_channel(channel.topic, "protobuf", schema)
                    channels[channel.topic] = number
                time = message.log_time
                writer.add_message(channels[channel.topic], time, again.SerializeToString(), time)
        writer.finish()
    return target


def _said_again(kind: str, said: Any, packed: bool) -> Iterator[Any]:
    match kind.split("/")[-1]:
        case "TFMessage":
            moved = [_transform(one) for one in said.transforms]
            yield from moved if packed else [FrameTransforms(transforms=moved)]
        case "Image" if packed and said.encoding == "16UC1":
            values = np.frombuffer(said.data, "<u2").reshape(said.height, -1)[:, : said.width]
            yield CompressedImage(format="png", data=png(values), **_head(said))
        case "Image":
            size = {"width": said.width, "height": said.height, "step": said.step}
            yield RawImage(encoding=said.encoding, data=bytes(said.data), **size, **_head(said))
        case "CameraInfo":
            size = {"width": said.width, "height": said.height}
            yield CameraCalibration(K=list(said.k), D=list(said.d), **size, **_head(said))
        case "JointState":
            pairs = zip(said.name, said.position, strict=True)
            joints = [JointState(name=name, position=value) for name, value in pairs]
            yield JointStates(timestamp=_head(said)["timestamp"], joints=joints)
        case "String" if packed:
            key, _, value = said.data.partition(" ")
            yield KeyValuePair(key=key, value=value)
        case "String":
            yield Log(message=said.data)
        case "CompressedImage" if said.format == "png":
            yield CompressedImage(format="png", data=bytes(said.data), **_head(said))
        case "PoseStamped":
            yield PoseInFrame(pose=_pose(said.pose), **_head(said))
        case "PoseArray":
            yield PosesInFrame(poses=[_pose(one) for one in said.poses], **_head(said))
        case "PointStamped":
            yield Point3InFrame(point=_xyz(said.point), **_head(said))
        case "PointCloud2":
            points = packed_points(
                said.data,
                {field.name: (field.offset, field.datatype) for field in said.fields},
                said.point_step,
                size=(said.width, said.height),
                row=said.row_step,
                big_endian=said.is_bigendian,
            )
            fields = [
                PackedElementField(name=name, offset=8 * k, type=PackedElementField.FLOAT64)
                for k, name in enumerate("xyz")
            ]
            yield PointCloud(
                pose={"position": {"x": 1.0}, "orientation": {"w": 2.0}},
                point_stride=24,
                fields=fields,
                data=(points - [1.0, 0.0, 0.0]).tobytes(),
                **_head(said),
            )


def _xyz(one: Any) -> dict[str, float]:
    return {name: getattr(one, name) for name in "xyzw" if hasattr(one, name)}


def _pose(one: Any) -> dict[str, Any]:
    return {"position": _xyz(one.position), "orientation": _xyz(one.orientation)}


def _transform(one: Any) -> FrameTransform:
    return FrameTransform(
        timestamp=_head(one)["timestamp"],
        parent_frame_id=one.header.frame_id,
        child_frame_id=one.child_frame_id,
        translation=_xyz(one.transform.translation),
        rotation=_xyz(one.transform.rotation),
    )


def _head(said: Any) -> dict[str, Any]:
    stamp = said.header.stamp
    return {
        "timestamp": {"seconds": stamp.sec, "nanos": stamp.nanosec},
        "frame_id": said.header.frame_id,
    }
