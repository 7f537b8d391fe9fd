"""What `replay recover` saves of a damaged or unfinished recording, and what it never makes up."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from replay.__main__ import main
from replay.comparing.verification import EQUAL, NO_RESULT, verify
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from replay.mcap.reader import read_recording
from replay.mcap.records import ENDS_EARLY, NO_RECORD
from replay.mcap.recovery import Recovered, recover, tells_loss
from replay.mcap.writer import McapRecorder
from tests.tools.kill_sessions import PROBES, quick_session
from tests.tools.mutations import joined, packed, split, unpacked

PAGE = 4096
Same = Callable[[object, object], None]


def recorded(path: Path, events: list[Event], *flush_before: type[Event]) -> bytes:
    """A recording of events with a chunk for each probe, as a session leaves it."""
    recorder = McapRecorder(path)
    for event in events:
        if isinstance(event, (Probe, SessionEnded, *flush_before)):
            recorder.flush()
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


def test_a_whole_recording_is_copied_and_nothing_is_lost(
    tmp_path: Path, events: list[Event], assert_same: Same, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    recorded(path, events)
    assert main(["recover", str(path), "-o", str(out)]) == 0
    assert capsys.readouterr().out == (
        "nothing is lost: the recording is whole\n"
        f"kept: 3 probes, 2 registration problems, 2 results\n{out}\n"
    )
    assert_same(read_recording(out).events(), events)


@pytest.fixture
def many(make_events: Callable[..., list[Event]]) -> list[Event]:
    """Six probes, each larger than a page."""
    return make_events(steps=6, free=400)


def flipped(data: bytes, start: int, end: int) -> bytes:
    middle = (start + end) // 2
    return data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]


def wrong_length(data: bytes, start: int, _: int) -> bytes:
    return data[: start + 1] + struct.pack("<Q", 2**40) + data[start + 9 :]


def removed_chunk(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + data[end:]


@pytest.mark.parametrize("damage", [flipped, wrong_length, removed_chunk])
def test_of_a_damaged_chunk_all_other_probes_come_back(
    tmp_path: Path,
    many: list[Event],
    assert_same: Same,
    damage: Callable[[bytes, int, int], bytes],
) -> None:
    data = recorded(tmp_path / "whole.mcap", many)
    chunks = chunks_of(data, "/probe")
    assert len(chunks) == 6
    for step, chunk in enumerate(chunks):
        events, found = recovered(tmp_path, damage(data, *chunk))
        others = [probe for probe in probes(many) if probe.step != step]
        assert_same(probes(events), others)
        assert found.lost_probes == [(step, step)]
        assert found.probes == [probe.step for probe in others]
        assert found.lost_problems == list(range(max(step, 1), 6))  # their points are not all here
        assert found.messages > 0
        assert not found.nothing_lost
        # Before the damage all is as it was, and behind it all that does not hang on what is lost.
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
    (tmp_path / "cut.mcap").write_bytes(data[: chunks_of(data, "/probe")[1][1]])
    assert main(["recover", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "out.mcap")]) == 0
    output = capsys.readouterr().out
    assert "is unfinished" in output
    assert "kept: 2 probes, 1 registration problems, 1 results\n" in output
    kept = list(read_recording(tmp_path / "out.mcap").events())
    assert_same(kept[:-1], events[: len(kept) - 1])
    assert isinstance(kept[-1], SessionEnded)
    assert "recovered: how the session ended is not known" in kept[-1].outcome


BEHIND = "this is behind the recording's end"


def wrong_summary(data: bytes) -> bytes:
    return data[:-20] + bytes([data[-20] ^ 1]) + data[-19:]


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (lambda data: data + b"garbage" * 1000, [BEHIND]),
        (lambda data: data + bytes(PAGE), [BEHIND]),
        (lambda data: data + data, [BEHIND]),
        (lambda data: data[:-30] + data, [NO_RECORD, "another recording begins here"]),
        (lambda data: data[:-30], [ENDS_EARLY]),
        (lambda data: b"\0" + data[1:], [NO_RECORD]),
        (lambda data: data[:8] + b"\x77" + data[9:], [NO_RECORD]),
        (wrong_summary, []),
    ],
    ids=[
        "garbage",
        "zeros",
        "twice",
        "cut and twice",
        "no footer",
        "no magic",
        "header",
        "summary",
    ],
)
def test_damage_outside_the_session_loses_nothing(
    tmp_path: Path,
    events: list[Event],
    assert_same: Same,
    change: Callable[[bytes], bytes],
    lost: list[str],
) -> None:
    data = change(recorded(tmp_path / "whole.mcap", events))
    kept, found = recovered(tmp_path, data)
    assert_same(kept, events)
    assert found.nothing_lost
    assert found.damage is not None
    assert [damage.reason for damage in found.damages] == lost


def test_what_is_lost_behind_the_end_is_reported_alone(
    tmp_path: Path, events: list[Event], assert_same: Same
) -> None:
    data = recorded(tmp_path / "whole.mcap", events, SessionEnded)
    for damage in (flipped, removed_chunk):
        kept, found = recovered(tmp_path, damage(data, *chunks_of(data, "/contents")[-1]))
        assert isinstance(kept[-1], SessionEnded)
        assert not found.complete
        assert not found.nothing_lost
        assert_same(without_marks(kept), events[: len(without_marks(kept))])


def test_two_recordings_in_one_file_are_never_mixed(
    tmp_path: Path, make_events: Callable[..., list[Event]], assert_same: Same
) -> None:
    one, other = make_events(steps=3, seed=1), make_events(steps=5, seed=2)
    data = recorded(tmp_path / "one.mcap", one)
    cut = data[: chunks_of(data, "/probe")[1][0] + 50]
    second = recorded(tmp_path / "other.mcap", other)
    for damaged in (second, b"\0" * 300 + second[300:], second[chunks_of(second)[0][0] :]):
        kept = without_marks(recovered(tmp_path, cut + damaged)[0])
        assert len(probes(kept)) == 1
        assert_same(kept, one[: len(kept)])


@pytest.mark.parametrize("at", [1, 2, 4])
@pytest.mark.parametrize("gap", [0, 1])
def test_probes_of_another_session_are_refused_though_their_numbers_fit(
    tmp_path: Path,
    make_events: Callable[..., list[Event]],
    assert_same: Same,
    capsys: pytest.CaptureFixture[str],
    at: int,
    gap: int,
) -> None:
    """Two sessions with as many messages, spliced between two chunks, or where one is missing."""
    one, other = make_events(steps=6, seed=1), make_events(steps=6, seed=2)
    first = recorded(tmp_path / "one.mcap", one)
    second = recorded(tmp_path / "other.mcap", other)
    start = chunks_of(second, "/probe")[at + gap][0]
    spliced = first[: chunks_of(first, "/probe")[at][0]] + second[start:]
    kept, found = recovered(tmp_path, spliced)
    assert_same(probes(kept), probes(one)[:at])
    assert_same(without_marks(kept), one[: len(without_marks(kept))])
    mixed = [damage for damage in found.damages if "two recordings are mixed" in damage.reason]
    assert len(mixed) == 6 - at - gap + 1  # and the end
    assert not found.complete
    path = tmp_path / "spliced.mcap"
    path.write_bytes(spliced)
    assert main(["verify", str(path)]) == 2
    expected = ["two recordings are mixed in this file", "is missing, "]
    assert expected[gap] in capsys.readouterr().err
    assert main(["recover", str(path), "-o", str(tmp_path / "out.mcap")]) == 0
    shown = capsys.readouterr()
    assert (shown.err, shown.out[:6]) == ("", "kept: ")
    assert "two recordings are mixed" in " ".join(shown.out.split())


def test_a_session_that_goes_on_in_a_file_of_older_format_is_refused(
    tmp_path: Path, make_events: Callable[..., list[Event]]
) -> None:
    """Chunks without a seal belong to no recording of this format."""
    one = make_events(steps=6)
    data = recorded(tmp_path / "one.mcap", one)
    chunk = chunks_of(data, "/probe")[2]
    record = split(data[slice(*chunk)])[0]
    inside = split(unpacked(record[1]))
    unsealed = [part for part in inside[:-1] if part[0] == Opcode.MESSAGE]
    changed = data[: chunk[0]] + joined([(Opcode.CHUNK, packed(joined(unsealed)))])
    _, found = recovered(tmp_path, changed + data[chunk[1] :])
    assert found.probes == [0, 1, 3, 4, 5]
    assert any("the chunk has no seal of this recording" in d.reason for d in found.damages)


def test_repeated_and_swapped_chunks_are_not_believed_twice(
    tmp_path: Path, many: list[Event], assert_same: Same
) -> None:
    data = recorded(tmp_path / "whole.mcap", many)
    parts = [start for start, _ in chunks_of(data, "/probe")]
    head, *bodies = [data[a:b] for a, b in zip([0, *parts], [*parts, None], strict=True)]
    repeated = [head, bodies[0], bodies[0], *bodies[1:]]
    kept, found = recovered(tmp_path, b"".join(repeated))
    assert_same(kept, many)
    assert [d.reason for d in found.damages] == ["the messages of a chunk were there before"]
    swapped = [head, bodies[0], bodies[2], bodies[1], *bodies[3:]]
    kept, found = recovered(tmp_path, b"".join(swapped))
    assert_same(probes(kept), [probe for probe in probes(many) if probe.step != 1])
    assert found.lost_probes == [(1, 1)]


def test_a_result_is_never_given_an_older_archive(tmp_path: Path, events: list[Event]) -> None:
    """Where a result says that its archive is the last snapshot, and that one is lost."""
    data = recorded(tmp_path / "whole.mcap", events, HypothesesFound, SnapshotTaken)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/archive")[-1]))
    assert sum(isinstance(event, SnapshotTaken) for event in kept) == 3
    assert [event.step for event in kept if isinstance(event, HypothesesFound)] == [1]
    assert found.lost_results == [2]
    assert found.lost_problems == []
    assert any("the archive of step 2 is missing" in text for text in found.events)


@pytest.fixture(scope="module", params=["gradient_descent", "chsel"])
def session(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of real registrations after every one of PROBES probes."""
    folder = tmp_path_factory.mktemp(request.param)
    quick_session(folder, request.param)(folder / "logs")
    (path,) = folder.rglob("recording.mcap")
    return path


def test_behind_a_lost_result_verify_does_not_judge_by_the_result_before_it(
    session: Path, tmp_path: Path
) -> None:
    """Step 2 keeps its problem alone; step 4 follows from the result of a step that is lost."""
    written = list(read_recording(session).events())
    data = recorded(tmp_path / "whole.mcap", written, HypothesesFound, ProblemPosed)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/hypotheses")[2]))
    results = [event.step for event in kept if isinstance(event, HypothesesFound)]
    problems = [event.step for event in kept if isinstance(event, ProblemPosed)]
    assert found.lost_results[:1] == [2]
    assert {0, 1, 4, 5} <= set(results)
    assert 2 in problems
    assert 2 not in results
    assert not found.lost_probes
    recording = read_recording(tmp_path / "recovered.mcap")
    outcomes = {verdict.step: verdict.outcome for verdict in verify(recording)}
    assert outcomes.pop(2) == NO_RESULT
    assert set(outcomes.values()) == {EQUAL}
    # The sets are compared again as soon as the result that they follow from is known.
    verdicts = {verdict.step: verdict.before for verdict in verify(recording)}
    first = min(step for step in problems if step > 2)
    assert verdicts[first] == verdicts[0] - 2
    assert verdicts[PROBES - 1] == verdicts[0]


def test_registrations_before_a_lost_probe_verify(session: Path, tmp_path: Path) -> None:
    data = session.read_bytes()
    events, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/probe")[3]))
    assert found.lost_probes == [(3, 3)]
    assert found.problems == found.results == [0, 1, 2]
    verdicts = list(verify(read_recording(tmp_path / "recovered.mcap")))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL] * 3
    assert len(probes(events)) == PROBES - 1


def test_the_report_tells_bytes_probes_and_registrations(
    tmp_path: Path, many: list[Event], capsys: pytest.CaptureFixture[str]
) -> None:
    data = recorded(tmp_path / "whole.mcap", many)
    chunks = chunks_of(data, "/probe")
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    path.write_bytes(flipped(flipped(data, *chunks[3]), *chunks[1]))
    assert main(["recover", str(path), "-o", str(out)]) == 0
    output = " ".join(capsys.readouterr().out.split())
    for start, end in (chunks[1], chunks[3]):
        assert f"{start} {end} " in output
    assert "lost probes: those of step 1, 3" in output
    assert "lost registration problems: those of step 1, 2, 3, 4, 5" in output
    assert "kept: 4 probes, 0 registration problems, 0 results" in output
    path.write_bytes(flipped(data, *chunks[1])[: chunks[-1][0]])
    out.unlink()
    assert main(["recover", str(path), "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert "lost probes: at most those of step 1\n" in output
    assert "the session's end is missing: what else was in it cannot be known\n" in output


def test_losses_are_told_in_the_recording_where_they_are(tmp_path: Path, many: list[Event]) -> None:
    data = recorded(tmp_path / "whole.mcap", many)
    kept, found = recovered(tmp_path, flipped(data, *chunks_of(data, "/probe")[2]))
    first = next(index for index, event in enumerate(kept) if tells_loss(event))
    text = f"recovered: {found.messages} messages are lost here"
    assert kept[first] == Logged(1, "warning", text)
    assert isinstance(kept[first + 1], Probe)
    assert kept[first + 1].step == 3
    assert not any(isinstance(event, SessionStarted) for event in kept[1:])


def test_without_the_start_nothing_can_be_recovered(
    tmp_path: Path, events: list[Event], capsys: pytest.CaptureFixture[str]
) -> None:
    data = recorded(tmp_path / "whole.mcap", events)
    middle = sum(chunks_of(data)[0]) // 2
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    path.write_bytes(data[:middle] + bytes(8) + data[middle + 8 :])
    assert main(["recover", str(path), "-o", str(out)]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert errors.startswith(f"error: nothing can be recovered from {path} (bytes ")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["damaged.mcap", "whole.mcap"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "nothing can be recovered"),
        (MCAP0_MAGIC, "nothing can be recovered"),
        (b"solid cube\n" * 500, "nothing can be recovered"),
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
