"""What the reader gives back, and how it meets files that are not what they should be."""

import io

import numpy as np
import pytest
import trimesh
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, Writer

from chsel.errors import RecordingError
from chsel.events import ProblemPosed
from replay.mcap.encoding import decode, encode, message_class
from replay.mcap.reader import read_recording
from replay.mcap.schemas import FORMAT_VERSION, RECORDS
from tests.replay.conftest import nth


def rewritten(path, change):
    """A whole, checksummed copy of a recording with other messages or attachments.

    change: gets topic or attachment name and the bytes; gives new bytes, or None to leave out.
    """
    copy = path.with_suffix(".changed.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, enable_data_crcs=True)
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


def test_plain_mcap_and_protobuf_rebuild_a_problem(events, write):
    """Without any code of this project: the file describes itself."""
    with write(events).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        attachments = {item.name: item.data for item in reader.iter_attachments()}
        stored = [(c.topic, s.name, m) for s, c, m in reader.iter_messages()]
    pool = descriptor_pool.DescriptorPool()
    for schema in summary.schemas.values():
        for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(proto)

    def parsed(name, data):
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(data)

    def array(message):
        stored = np.frombuffer(message.data, message.dtype).reshape(tuple(message.shape))
        return stored.astype(np.float64)  # a grid may be stored in 32 bits

    points, elites = {"free": [], "occupied": [], "known": []}, None
    for topic, name, message in stored:
        content = parsed(name, message.data)
        if topic.startswith("/points/"):
            columns = content.point_stride // 8
            points[topic[8:]].append(np.frombuffer(content.data, "<f8").reshape(-1, columns))
        if topic == "/hypotheses":
            elites = array(content.elites)
        if topic == "/problem" and content.step == 2:
            break
    low_cost_set = array(content.low_cost_set) if content.HasField("low_cost_set") else elites
    grid = parsed("chsel.SdfGrid", attachments["sdf_grid"])
    expected = nth(events, ProblemPosed, 1).problem
    known = np.concatenate(points["known"])
    for found, wanted in (
        (np.concatenate(points["free"]), expected.points.free),
        (np.concatenate(points["occupied"]), expected.points.occupied),
        (known[:, :3], expected.points.known),
        (known[:, 3], expected.points.sdf),
        (array(content.initial_set), expected.initial_set),
        (low_cost_set, expected.low_cost_set),
        (array(content.workspace), expected.workspace.bounds),
        (array(grid.values), expected.sdf.values),
        (array(grid.gradients), expected.sdf.gradients),
        (array(grid.origin), expected.sdf.origin),
    ):
        assert found.shape == wanted.shape
        assert found.tobytes() == wanted.tobytes()
    assert grid.resolution == expected.sdf.resolution
    assert (content.key_seed, content.key_step) == (expected.key.seed, expected.key.step)
    assert content.free_resolution == expected.free_resolution
    assert content.digest == expected.digest
    mesh = trimesh.load(io.BytesIO(attachments["mesh.ply"]), file_type="ply", process=False)
    assert mesh.vertices.tobytes() == events[0].mesh.vertices.tobytes()
    assert mesh.faces.tolist() == events[0].mesh.faces.tolist()


def test_other_files_are_refused(tmp_path):
    path, others = tmp_path / "recording.mcap", io.BytesIO()
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
