"""What `replay recover` saves of a damaged or unfinished recording, and what it never makes up."""

import dataclasses
import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from chsel.errors import RecordingError, SessionError
from chsel.events import (
    ActionsOffered,
    Decided,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionEnded,
    SnapshotTaken,
    Traced,
)
from chsel.next_probe.decision_problem import Actions
from chsel.problem.poses import axis_angle, compose
from chsel.problem.sdf_grid import object_grid
from chsel.session.session import Session
from replay.__main__ import main
from replay.comparing.verification import EQUAL, NO_RESULT, verify
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover, tells_loss
from replay.mcap.writer import McapRecorder
from replay.verbs.info import recording_info
from tests.replay.conftest import example_events, nth, same_bits
from tests.tools.small_recordings import registered_session


def recorded(path, events, *flush_before):
    """A recording of events with a chunk for each probe, as a session leaves it."""
    recorder = McapRecorder(path)
    flushed = -1
    for event in events:
        is_first = isinstance(event, Probe | SensorImage) and event.step > flushed
        if is_first or isinstance(event, (SessionEnded, *flush_before)):
            recorder.flush()
            flushed = event.step
        recorder.record(event)
    recorder.close()
    return path.read_bytes()


def chunks_of(data, topic=None):
    """Start and end of every chunk, or of those with messages on a topic."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    channels = {c.id for c in summary.channels.values() if topic in (None, c.topic)}
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
        for index in summary.chunk_indexes
        if channels & set(index.message_index_offsets)
    ]


def recovered(folder, data):
    """The events that come back of a file with these bytes, strictly read, and the report."""
    damaged, out = folder / "damaged.mcap", folder / "recovered.mcap"
    damaged.write_bytes(data)
    out.unlink(missing_ok=True)
    found = recover(damaged, out)
    assert damaged.read_bytes() == data
    assert sorted(file.name for file in folder.iterdir() if "recovered" in file.name) == [out.name]
    return list(read_recording(out).events()), found


def without_marks(events):
    """What was in the damaged file: events without the warnings and the end that were added."""
    kept = [event for event in events if not tells_loss(event)]
    if isinstance(kept[-1], SessionEnded) and "recovered: " in kept[-1].outcome:
        del kept[-1]
    return kept


def probes(events):
    return [event for event in events if isinstance(event, Probe)]


def flipped(data, start, end):
    middle = (start + end) // 2
    return data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]


def wrong_length(data, start, _):
    return data[: start + 1] + struct.pack("<Q", 2**40) + data[start + 9 :]


def test_a_whole_recording_is_copied_and_nothing_is_lost(
    tmp_path, sensor_events, assert_same, capsys
):
    path, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    recorded(path, sensor_events)
    assert main(["recover", str(path), "-o", str(out)]) == 0
    assert capsys.readouterr().out == (
        "nothing is lost: the recording is whole\n"
        f"kept: 3 probes, 2 registration problems, 2 results, 12 images\n{out}\n"
    )
    assert_same(read_recording(out).events(), sensor_events)


@pytest.mark.parametrize("damage", [flipped, wrong_length])
def test_of_a_damaged_chunk_all_other_probes_come_back(tmp_path, assert_same, damage):
    many = example_events(steps=6, free=400)
    data = recorded(tmp_path / "whole.mcap", many)
    chunks = chunks_of(data, "/probe")
    assert len(chunks) == 6
    for step, chunk in enumerate(chunks):
        events, found = recovered(tmp_path, damage(data, *chunk))
        others = [probe for probe in probes(many) if probe.step != step]
        assert_same(probes(events), others)
        assert found.probes == [probe.step for probe in others]
        assert f"bytes {chunk[0]} to {chunk[1]}" in found.lost
        # Before the damage all is as it was; behind it no problem has all of its points.
        lost = {step for step in range(6) if f"the registration of step {step}" in found.lost}
        assert lost == set(range(max(step + 1, 1), 6))
        assert found.problems == found.results == list(range(1, step))
        first = many.index(probes(many)[step])
        assert_same(events[:first], many[:first])
        assert tells_loss(events[first])
        assert events[-1] == many[-1]
        numbers = [e for e in many if isinstance(e, Measured) and e.step != step]
        assert_same([e for e in events if isinstance(e, Measured)], numbers)


def test_an_unfinished_recording_gets_an_end_that_says_so(tmp_path, events, assert_same, capsys):
    data = recorded(tmp_path / "whole.mcap", events)
    path, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    path.write_bytes(data[: chunks_of(data, "/probe")[2][0] + 40])
    assert main(["recover", str(path), "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert "the file was not whole: it is unfinished\n" in output
    assert "kept: 2 probes, 1 registration problems, 1 results\n" in output
    assert "lost: bytes " in output
    assert "the session's end is missing: what else was in it cannot be known\n" in output
    kept = list(read_recording(out).events())
    assert_same(without_marks(kept), events[: len(without_marks(kept))])
    assert nth(kept, SessionEnded).outcome == "recovered: how the session ended is not known"


def test_a_result_is_never_given_an_older_archive(tmp_path, events):
    """Where a result says that its archive is the last snapshot, and that one is lost."""
    data = recorded(tmp_path / "whole.mcap", events, HypothesesFound, SnapshotTaken)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/archive")[-1]))
    assert sum(isinstance(event, SnapshotTaken) for event in kept) == 3
    assert (found.problems, found.results) == ([1, 2], [1])
    assert "the archive of step 2 is missing" in found.lost["the registration of step 2"]


def test_decisions_without_their_actions_are_lost(tmp_path, steered_events):
    data = recorded(tmp_path / "actions.mcap", steered_events)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/actions")[0]))
    assert not any(isinstance(event, Decided | ActionsOffered) for event in kept)
    assert "/decision of step 1" in found.lost
    assert (found.probes, found.results) == ([0, 1, 2], [1, 2])
    data = recorded(tmp_path / "steered.mcap", steered_events, Decided)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/probe")[1]))
    assert [event.step for event in kept if isinstance(event, Decided)] == [-1, 0]
    assert {"/decision of step 1", "/decision of step 2"} <= set(found.lost)


def test_each_decision_comes_back_on_the_actions_that_were_offered_last(tmp_path, steered_events):
    """Others are offered before the second decision, and the end of the file is cut off."""
    first = nth(steered_events, ActionsOffered)
    second = nth(steered_events, Decided, number=1)
    place = 0
    turn = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(1.1)), np.array([0.3, 0.2, 0.1]))
    others = Actions(turn @ first.actions.world_from_hand, first.actions.length + 0.1)
    offered = dataclasses.replace(first, step=second.step, actions=others)
    events = []
    for event in steered_events:
        if event is second:
            place = len(events)
            events.append(offered)
        if place and isinstance(event, Decided):
            problem = dataclasses.replace(event.problem, actions=others)
            event = dataclasses.replace(event, problem=problem)
        events.append(event)
    data = recorded(tmp_path / "whole.mcap", events, Decided)
    kept, _ = recovered(tmp_path, data[: chunks_of(data, "/decision")[-1][0] + 40])
    digests = [e.problem.actions.digest for e in kept if isinstance(e, Decided)]
    assert digests == [first.actions.digest] + [others.digest] * (len(digests) - 1)
    assert len(digests) == 3


def test_verify_does_not_judge_by_what_is_lost(tmp_path):
    """Step 0 keeps its problem alone, so that the sets of step 1 do not follow from it."""
    written = registered_session("chsel")
    data = recorded(tmp_path / "whole.mcap", written, HypothesesFound, ProblemPosed)
    _, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/hypotheses")[0]))
    assert found.probes == [0, 1]
    assert found.problems[0] == 0
    assert 0 not in found.results
    recording = read_recording(tmp_path / "recovered.mcap")
    outcomes = [verdict.outcome for verdict in verify(recording)]
    assert outcomes == [NO_RESULT, EQUAL][: len(found.problems)]


@pytest.mark.parametrize("resolution", [0.02, None])
def test_a_damaged_grid_is_made_again_from_the_mesh(
    tmp_path, events, assert_same, capsys, resolution
):
    config = {"session": {"object_resolution": resolution, "object_padding": 0.03}}
    grid = object_grid(events[0].mesh, resolution, padding=0.03)
    start = dataclasses.replace(events[0], sdf=grid, config=config)
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    data = recorded(tmp_path / "whole.mcap", [start])
    place = data.index(b"sdf_grid") + 2000
    path.write_bytes(flipped(data, place, end=place))
    assert main(["recover", str(path), "-o", str(out)]) == 0
    assert "made again from the mesh, to the bit" in capsys.readouterr().out
    assert_same(without_marks([*read_recording(out).events()]), [start])
    place = data.index(b"end_header") + 20
    path.write_bytes(flipped(data, place, end=place))
    assert main(["recover", str(path), "-o", str(tmp_path / "no.mcap")]) == 2
    assert "nothing can be recovered" in (error := capsys.readouterr().err)
    assert "attachment mesh.ply has digest" in error


def live_session(path, **arguments):
    """A session of a box of 40 x 60 x 80 mm, of two steps, and the events of its recording."""
    box = trimesh.creation.box((0.04, 0.06, 0.08))
    with Session(box, method="icp", record=path, **arguments) as session:
        for z in (0.01, 0.02):
            session.add(contacts=[[0.02, 0.0, z], [0.0, 0.03, z], [0.01, z, 0.04]])
            session.register()
    return list(read_recording(path).events())


def damaged_grid(path):
    """The bytes of a recording with one bit flipped amid its grid."""
    data = path.read_bytes()
    first = data.index(b"sdf_grid")
    last = data.index(b"chsel.SdfGrid", data.index(b"sdf_grid"))
    middle = last + len(read_recording(path).start.sdf.values.tobytes()) // 4
    assert first < last < middle
    return flipped(data, middle, end=middle)


@pytest.mark.parametrize("arguments", [{}, {"resolution": 0.0045}])
@pytest.mark.parametrize("earlier", [False, True])  # whose configuration lacks its settings
def test_a_live_session_with_a_damaged_grid_comes_back_whole(
    tmp_path, assert_same, arguments, earlier
):
    path = tmp_path / "whole.mcap"
    written = live_session(path, **arguments)
    if earlier:
        config = {**written[0].config, "session": {"kind": "live"}}
        written[0] = dataclasses.replace(written[0], config=config)
        path.unlink()
        recorded(path, written)
    events, found = recovered(tmp_path, damaged_grid(path))
    assert found.remade
    assert not found.lost
    assert_same(without_marks(events), written)
    verdicts = verify(read_recording(tmp_path / "recovered.mcap"))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL, EQUAL]


def test_a_grid_that_the_mesh_does_not_give_loses_the_registrations_alone(
    tmp_path, assert_same, steered_events, capsys
):
    """As of a mesh whose distances came from another version of a library."""
    sdf = steered_events[0].sdf
    other = dataclasses.replace(sdf, values=sdf.values * 1.001)
    posed = [
        dataclasses.replace(event, problem=dataclasses.replace(event.problem, sdf=other))
        if isinstance(event, ProblemPosed | Decided)
        else event
        for event in steered_events
    ]
    written = [dataclasses.replace(posed[0], sdf=other), *posed[1:]]
    recorded(tmp_path / "whole.mcap", written)
    events, found = recovered(tmp_path, damaged_grid(tmp_path / "whole.mcap"))
    assert not found.remade
    assert "the mesh gives another" in found.lost["the SDF grid"]
    assert_same(probes(events), probes(written))
    assert {"the registration of step 1", "/decision of step 1"} <= set(found.lost)
    unlike = (ProblemPosed, Decided, HypothesesFound, SnapshotTaken, Traced)
    assert not any(isinstance(event, unlike) for event in events)
    numbers = [event for event in written if isinstance(event, Measured)]
    assert_same([event for event in events if isinstance(event, Measured)], numbers)
    start = read_recording(tmp_path / "recovered.mcap").start
    assert start.sdf.digest != other.digest
    assert tells_loss(events[1])


examples = settings(
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)


@st.composite
def damages(draw):
    """Up to three damages: bits flipped, bytes zeroed, removed or put in, or all cut off."""
    kinds = st.sampled_from(["flip", "flip", "zero", "remove", "insert", "cut"])
    places = st.floats(0.0, 1.0, exclude_max=True) | st.floats(0.97, 1.0, exclude_max=True)
    one = st.tuples(kinds, places, st.sampled_from([1, 4, 60, 300, 4096]))
    drawn = draw(st.lists(one, min_size=1, max_size=3))

    def damage(data):
        for kind, place, length in drawn:
            if not data:
                break
            start = int(place * len(data))
            part = data[start : start + length]
            replaced = {
                "flip": bytes([part[0] ^ (1 << length % 8)]) + part[1:],
                "zero": bytes(len(part)),
                "remove": b"",
                "insert": b"\x06" * length + part,
                "cut": b"",
            }[kind]
            data = data[:start] + replaced + (b"" if kind == "cut" else data[start + length :])
        return data

    return damage


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A recording with a chunk for each of six probes: its bytes and events."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    return recorded(path, events := example_events(steps=6, free=400)), events


def answer(path, question):
    """What comes back, or the text of an error, which has to name the file on one line."""
    try:
        return question()
    except (RecordingError, SessionError) as error:
        text = str(error)
    assert str(path) in text
    assert "\n" not in text
    return text


def same(read, written):
    return len(read) == len(written) and all(map(same_bits, read, written))


@examples
@given(damage=damages())
def test_reading_and_recovering_a_damaged_recording(tmp_path, original, damage):
    """Strictly: all of it, or an error. Else how it began. Recovered: nothing that was not there.

    All of that is a finished recording, and every loss is reported.
    """
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    out.unlink(missing_ok=True)
    data, written = original
    path.write_bytes(damage(data))
    events = answer(path, lambda: list(read_recording(path).events()))
    assert isinstance(events, str) or same(events, written)
    begin = answer(path, lambda: list(read_recording(path, partial=True).events()))
    assert isinstance(begin, str) or same(begin, written[: len(begin)])
    info = answer(path, lambda: recording_info(path))
    if not isinstance(info, str):
        json.dumps(info, allow_nan=False)
    found = answer(path, lambda: recover(path, out))
    if isinstance(found, str):
        assert not out.exists()
        return
    kept = without_marks([*read_recording(out).events()])
    left = iter(written)
    for event in kept:
        assert any(same_bits(event, one) for one in left), event
    assert isinstance(begin, str) or len(kept) >= len(begin)
    assert found.lost or found.damage is not None or same(kept, written)
