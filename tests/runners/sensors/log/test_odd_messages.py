"""Messages of a log whose bytes are changed, all checksums right: sound, or counted as faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from chsel.problem.poses import check_rigid
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    ImageMessage,
    JointsMessage,
    PoseMessage,
    TransformMessage,
)
from runners.sensors.log.raw_log import RawLog
from tests.runners.sensors.small_logs import foxglove_sent, ros2_sent, write_foxglove, write_ros2

EXTREME = [
    *(np.uint32(value).tobytes() for value in (0, 1, 2**16, 2**31, 2**32 - 1)),
    *(np.float64(value).tobytes() for value in (0.0, np.nan, np.inf, -np.inf, 1e300, 5e-324)),
]
Part = tuple[float, float, bytes]  # which message, where in it, and what is put there


@pytest.fixture(scope="module", params=["ros2", "foxglove"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "whole.mcap"
    if request.param == "ros2":
        write_ros2(path, ros2_sent(2))
    else:
        write_foxglove(path, foxglove_sent())
    return path


def changed(whole: Path, path: Path, parts: list[Part]) -> None:
    """A log with bytes put in the place of others within messages."""
    with whole.open("rb") as file:
        reader = make_reader(file)
        summary, messages = reader.get_summary(), list(reader.iter_messages())
    assert summary is not None
    contents = [bytearray(message.data) for _, _, message in messages]
    for which, where, new in parts:
        content = contents[int(which * len(contents))]
        start = int(where * len(content)) // 4 * 4
        content[start : start + len(new)] = new
    with path.open("wb") as target:
        writer = Writer(target)
        writer.start()
        for schema in summary.schemas.values():
            writer.register_schema(schema.name, schema.encoding, schema.data)
        for channel in summary.channels.values():
            writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id)
        for (_, _, message), content in zip(messages, contents, strict=True):
            writer.add_message(message.channel_id, message.log_time, bytes(content), 0)
        writer.finish()


def check(content: Content) -> None:
    """Assert that a message is as the types of messages promise."""
    match content:
        case ImageMessage():
            assert content.values.ndim == 2
            assert content.values.size > 0
            assert content.values.dtype in (np.uint16, np.float32)
        case CameraInfoMessage():
            numbers = [content.fx, content.fy, content.cx, content.cy]
            assert np.isfinite(numbers).all()
            assert min(numbers[:2]) > 0
        case TransformMessage():
            check_rigid("transform", content.parent_from_child[None])
        case PoseMessage():
            check_rigid("pose", content.frame_from_body[None])
        case JointsMessage():
            assert all(np.isfinite(value) for value in content.positions.values())
        case CloudMessage():
            assert content.points.ndim == 2
            assert content.points.dtype == np.float64


@settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    parts=st.lists(
        st.tuples(
            st.floats(0.0, 1.0, exclude_max=True),
            st.floats(0.0, 1.0, exclude_max=True),
            st.sampled_from(EXTREME) | st.binary(max_size=12),
        ),
        min_size=1,
        max_size=3,
    )
)
def test_changed_messages_are_sound_or_faults(
    whole: Path, tmp_path: Path, parts: list[Part]
) -> None:
    path = tmp_path / "changed.mcap"
    changed(whole, path, parts)
    log = RawLog(path)
    for received in log.messages(log.topics):
        assert received.stamp is None or 0 < received.stamp < 2**63
        check(received.content)
    assert not any("\n" in text for text in log.faults)
