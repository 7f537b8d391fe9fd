"""What `replay recover` saves of a damaged or unfinished recording, and what it never makes up."""

from __future__ import annotations

import dataclasses
import io
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from chsel.problem.defaults import object_grid
from replay.__main__ import main
from replay.comparing.verification import EQUAL, NO_RESULT, verify
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from replay.mcap.reader import read_recording
from replay.mcap.recovery import Recovered, recover, tells_loss
from replay.mcap.writer import McapRecorder
from tests.tools.small_recordings import registered_session

Same = Callable[[object, object], None]
Damage = Callable[[bytes, int, int], bytes]


def recorded(path: Path, events: list[Event], *flush_before: type[Event]) -> bytes:
    """A recording of events with a chunk for each probe, as a session leaves it."""
    recorder, flushed = McapRecorder(path), -1
    for event in events:
        is_first = isinstance(event, Probe | SensorImage) and event.step > flushed
        if is_first or isinstance(event, (SessionEnded, *flush_before)):
            recorder.flush()
            flushed = event.step
        recorder.record(event)
    recorder.close()
    return path.read_bytes()


def chunks_of(data: bytes, topic: str | None = None) -> list[tuple[int, int]]:
    """Start and end of every chunk, or of those with messages on a topic."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    channels = {c.id for c in summary.channels.values() if topic in (None, c.topic)}
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
        for index in summary.chunk_indexes
        if channels & set(index.message_index_offsets)
    ]


def recovered(folder: Path, data: bytes) -> tuple[list[Event], Recovered]:
    """The events that come back of a file with these bytes, strictly read, and the report."""
    damaged, out = folder / "damaged.mcap", folder / "recovered.mcap"
    damaged.write_bytes(data)
    out.unlink(missing_ok=True)
    found = recover(damaged, out)
    assert damaged.read_bytes() == data
    assert sorted(file.name for file in folder.iterdir() if "recovered" in file.name) == [out.name]
    return list(read_recording(out).events()), found


def without_marks(events: list[Event]) -> list[Event]:
    """What was in the damaged file: events without the warnings and the end that were added."""
    kept = [event for event in events if not tells_loss(event)]
    if isinstance(kept[-1], SessionEnded) and "recovered: " in kept[-1].outcome:
        del kept[-1]
    return kept


def probes(events: list[Event]) -> list[Event]:
    return [event for event in events if isinstance(event, Probe)]


def flipped(data: bytes, start: int, end: int) -> bytes:
    middle = (start + end) // 2
    return data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]


def wrong_length(data: bytes, start: int, _: int) -> bytes:
    return data[: start + 1] + struct.pack("<Q", 2**40) + data[start + 9 :]


def test_a_whole_recording_is_copied_and_nothing_is_lost(
    tmp_path: Path,
    sensor_events: list[Event],
    assert_same: Same,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    recorded(path, sensor_events)
    assert main(["recover", str(path), "-o", str(out)]) == 0
    assert capsys.readouterr().out == (
        "nothing is lost: the recording is whole\n"
        f"kept: 3 probes, 2 registration problems, 2 results, 12 images\n{out}\n"
    )
    assert_same(read_recording(out).events(), sensor_events)


@pytest.mark.parametrize("damage", [flipped, wrong_length])
def test_of_a_damaged_chunk_all_other_probes_come_back(
    tmp_path: Path, make_events: Callable[..., list[Event]], assert_same: Same, damage: Damage
) -> None:
    many = make_events(steps=6, free=400)
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


def test_an_unfinished_recording_gets_an_end_that_says_so(
    tmp_path: Path, events: list[Event], assert_same: Same, capsys: pytest.CaptureFixture[str]
) -> None:
    data = recorded(tmp_path / "whole.mcap", events)
    path, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    for extra in (0, 40):
        path.write_bytes(data[: chunks_of(data, "/probe")[2][0] + extra])
        out.unlink(missing_ok=True)
        assert main(["recover", str(path), "-o", str(out)]) == 0
        output = capsys.readouterr().out
        assert "the file was not whole: it is unfinished\n" in output
        assert "kept: 2 probes, 1 registration problems, 1 results\n" in output
        assert ("lost: bytes " in output) == (extra > 0)
        assert "the session's end is missing: what else was in it cannot be known\n" in output
        kept = list(read_recording(out).events())
        assert_same(without_marks(kept), events[: len(without_marks(kept))])
        assert isinstance(kept[-1], SessionEnded)
        assert kept[-1].outcome == "recovered: how the session ended is not known"


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-30],
        lambda data: data[:-20] + bytes([data[-20] ^ 1]) + data[-19:],
        lambda data: data + b"garbage" * 1000,
    ],
    ids=["no footer", "summary", "garbage"],
)
def test_damage_behind_the_session_loses_nothing(
    tmp_path: Path, events: list[Event], assert_same: Same, change: Callable[[bytes], bytes]
) -> None:
    kept, _ = recovered(tmp_path, change(recorded(tmp_path / "whole.mcap", events)))
    assert_same(without_marks(kept), events)


def test_chunks_of_another_session_do_not_fit(
    tmp_path: Path, make_events: Callable[..., list[Event]], assert_same: Same
) -> None:
    """Two sessions with as many messages, spliced: the points are not those of its problems."""
    one, other = make_events(steps=6, seed=1), make_events(steps=6, seed=2)
    first = recorded(tmp_path / "one.mcap", one)
    second = recorded(tmp_path / "other.mcap", other)
    spliced = (
        first[: chunks_of(first, "/probe")[2][0]] + second[chunks_of(second, "/probe")[2][0] :]
    )
    kept, found = recovered(tmp_path, spliced)
    assert found.damage is not None
    results = [event for event in kept if isinstance(event, HypothesesFound | ProblemPosed)]
    assert_same(results, [e for e in one if isinstance(e, HypothesesFound | ProblemPosed)][:2])


def test_a_result_is_never_given_an_older_archive(tmp_path: Path, events: list[Event]) -> None:
    """Where a result says that its archive is the last snapshot, and that one is lost."""
    data = recorded(tmp_path / "whole.mcap", events, HypothesesFound, SnapshotTaken)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/archive")[-1]))
    assert sum(isinstance(event, SnapshotTaken) for event in kept) == 3
    assert (found.problems, found.results) == ([1, 2], [1])
    assert "the archive of step 2 is missing" in found.lost["the registration of step 2"]


def test_images_and_decisions_without_what_they_need_are_lost(
    tmp_path: Path, sensor_events: list[Event], steered_events: list[Event]
) -> None:
    for events, topic, names in (
        (sensor_events, "/rig", "/sensor_image"),
        (steered_events, "/actions", "/decision"),
    ):
        data = recorded(tmp_path / f"{topic[1:]}.mcap", events)
        kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, topic)[0]))
        assert not any(event.topic in (topic, names) for event in kept)
        assert f"{names} of step 1" in found.lost
        assert found.probes == [0, 1, 2]
        assert found.results == [1, 2]


def test_verify_does_not_judge_by_what_is_lost(tmp_path: Path) -> None:
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


def test_a_damaged_grid_is_made_again_from_the_mesh(
    tmp_path: Path, events: list[Event], assert_same: Same, capsys: pytest.CaptureFixture[str]
) -> None:
    start = events[0]
    assert isinstance(start, SessionStarted)
    config = {"session": {"object_resolution": 0.02, "object_padding": 0.03}}
    grid = object_grid(start.mesh, 0.02, padding=0.03)
    start = dataclasses.replace(start, sdf=grid, config=config)
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    data = recorded(tmp_path / "whole.mcap", [start])
    place = data.index(b"sdf_grid") + 2000
    path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    assert main(["recover", str(path), "-o", str(out)]) == 0
    assert "made again from the mesh, to the bit" in capsys.readouterr().out
    assert_same(without_marks([*read_recording(out).events()]), [start])
    place = data.index(b"end_header") + 20
    path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    assert main(["recover", str(path), "-o", str(tmp_path / "no.mcap")]) == 2
    assert "nothing can be recovered" in (error := capsys.readouterr().err)
    assert "attachment mesh.ply has digest" in error


def test_losses_are_told_in_the_recording_where_they_are(
    tmp_path: Path, make_events: Callable[..., list[Event]]
) -> None:
    many = make_events(steps=6, free=400)
    data = recorded(tmp_path / "whole.mcap", many)
    start, end = chunks_of(data, "/probe")[2]
    kept, found = recovered(tmp_path, flipped(data, start, end))
    first = next(index for index, event in enumerate(kept) if tells_loss(event))
    reason = found.lost[f"bytes {start} to {end}"]
    expected = Logged(1, "warning", f"recovered: lost: bytes {start} to {end}: {reason}")
    assert kept[first] == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not an MCAP file"),
        (MCAP0_MAGIC, "nothing can be recovered"),
        (b"solid cube\n" * 500, "is not an MCAP file"),
        (None, "does not exist; accepted: a recording.mcap"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, content: bytes | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other"
    if content is not None:
        path.write_bytes(content)
    assert main(["recover", str(path), "-o", str(tmp_path / "out.mcap")]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert message in errors
    assert [file.name for file in tmp_path.iterdir()] == (["other"] if content is not None else [])


def test_no_file_is_ever_overwritten(
    tmp_path: Path, events: list[Event], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "whole.mcap"
    data = recorded(path, events)
    other, link = tmp_path / "other.mcap", tmp_path / "link.mcap"
    other.write_bytes(b"precious")
    link.symlink_to(tmp_path / "nowhere.mcap")
    for out in (path, other, link):
        assert main(["recover", str(path), "-o", str(out)]) == 2
        assert f"error: {out} exists; accepted: the name of a new file" in capsys.readouterr().err
    assert main(["recover", str(path), "-o", str(tmp_path / "no" / "out.mcap")]) == 2
    assert "does not exist; accepted: a file in one" in capsys.readouterr().err
    assert path.read_bytes() == data
    assert other.read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 3


def test_a_file_that_appears_meanwhile_is_not_overwritten(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    recorded(path, events)
    close = McapRecorder.close

    def close_late(recorder: McapRecorder) -> None:
        close(recorder)
        out.write_bytes(b"precious")

    monkeypatch.setattr(McapRecorder, "close", close_late)
    with pytest.raises(RecordingError, match="exists; accepted: the name of a new file"):
        recover(path, out)
    assert out.read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 2
