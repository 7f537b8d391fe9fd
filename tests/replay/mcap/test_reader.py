"""What the reader gives back, and how it meets files that are not what they should be."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, Writer

from chsel.errors import RecordingError
from chsel.events import ProblemPosed
from replay.mcap.encoding import decode, encode, message_class
from replay.mcap.reader import read_recording
from replay.mcap.schemas import FORMAT_VERSION, RECORDS


def rewritten(path, change):
    """A whole, checksummed copy of a recording with other messages or attachments.

    change: gets topic or attachment name and the bytes; gives new bytes, or None to leave out.
    """
    copy = path.with_suffix(".changed.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, enable_data_crcs=True)
        writer.start("chsel", "")
        for attachment in reader.iter_attachments():
            data = change(attachment.name, attachment.data)
            if data is not None:
                writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
        summary = reader.get_summary()
        for schema in summary.schemas.values():
            writer.register_schema(schema.name, schema.encoding, schema.data)
        channels = {}
        for channel in summary.channels.values():
            number = writer.register_channel(channel.topic, "protobuf", channel.schema_id)
            channels[channel.topic] = number
        sequence = 0
        for _, channel, message in reader.iter_messages():
            data = change(channel.topic, message.data)
            if data is not None:
                time = message.log_time
                writer.add_message(channels[channel.topic], time, data, time, sequence)
                sequence += 1
        writer.finish()
    return copy


def edited(topic, **values):
    """A change of some fields of all messages of a topic."""

    def change(name, data):
        return (
            encode(RECORDS[name], decode(RECORDS[name], data) | values) if name == topic else data
        )

    return change


def test_every_event_comes_back_to_the_bit(any_events, write, assert_same):
    recording = read_recording(write(any_events))
    assert recording.damage is None
    assert_same(recording.events(), any_events)


def test_problems_are_rebuilt_from_the_file_alone(events, write):
    recording = read_recording(write(events))
    posed = {e.step: e.problem for e in events if isinstance(e, ProblemPosed)}
    assert recording.steps == tuple(posed) == (1, 2)
    for step in reversed(recording.steps):
        problem = recording.problem(step)
        assert problem.digest == posed[step].digest
        assert problem.points.digest == posed[step].points.digest
        assert problem.low_cost_set.tobytes() == posed[step].low_cost_set.tobytes()
        assert problem.key == posed[step].key
    assert len(recording.problem(2).low_cost_set) == 12
    with pytest.raises(RecordingError, match="no registration problem of step 0; accepted: 1, 2"):
        recording.problem(0)
    with pytest.raises(RecordingError, match="no result of step 7; accepted: 1, 2"):
        recording.hypotheses(7)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "recording.mcap"
    others = io.BytesIO()
    writer = Writer(others)
    writer.start("ros2", "")
    writer.finish()
    for content, message in (
        (b"", "is not an MCAP file; accepted: a recording.mcap that this project wrote"),
        (MCAP0_MAGIC, "is unfinished"),
        (MCAP0_MAGIC * 2, "is damaged after byte"),
        (others.getvalue(), "is another program's"),
    ):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            read_recording(path)


def drop(*names):
    return lambda name, data: None if name in names else data


def test_another_format_version_is_named_before_all_else(events, write):
    def newer(name, data):
        if name != "/session":
            return data
        session = message_class("Session").FromString(data)
        session.format_version = FORMAT_VERSION + 1
        session.ClearField("workspace")
        return session.SerializeToString()

    with pytest.raises(RecordingError, match="it is of format 2; accepted: 1"):
        read_recording(rewritten(write(events), newer))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edited("/hypotheses", cost=np.zeros(5)), "the hypotheses of step 1 has digest"),
        (edited("/archive", cells=np.arange(12)), "an archive of step 1 has digest"),
        (edited("/known_points", new_digest="0"), "new points of step -1 has digest"),
        (edited("/known_points", occupied=9), "occupied points of step -1 are missing"),
        (edited("/session", config="[1]"), "its configuration is not a mapping"),
        (edited("/session", workspace=np.ones((2, 3))), "every lower bound below"),
        (edited("/session", world_from_object=np.eye(4) * 3.0), "is not a rigid transform"),
        (edited("/probe", step=1), "has a time of step 0, not its own"),
        (edited("/problem", sdf_digest="0"), "the SDF grid of the problem of step 1"),
        (drop("/points/occupied"), "occupied points of step 0 are missing"),
        (drop("/archive"), "the archive of step 1 is missing"),
        (drop("/hypotheses"), "the low-cost set of step 2 is missing"),
    ],
)
def test_content_that_contradicts_itself_is_refused(events, write, change, message):
    with pytest.raises(RecordingError, match=message):
        read_recording(rewritten(write(events), change))


def test_a_problem_that_is_not_the_recorded_one_is_refused(events, write):
    for change in (edited("/problem", initial_set=np.eye(4)[None]), edited("/problem", key_seed=1)):
        recording = read_recording(rewritten(write(events), change))
        with pytest.raises(RecordingError, match="the problem of step 2 has digest"):
            recording.problem(2)
        with pytest.raises(RecordingError, match="the problem of step 1 has digest"):
            list(recording.events())
