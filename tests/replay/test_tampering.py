"""Whoever changes what a recording holds, with all checksums right, is found out and named."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode

from chsel.errors import RecordingError
from replay.__main__ import main
from replay.comparing.event_differences import is_close
from replay.comparing.verification import DIFFERS, EQUAL, verify
from replay.content.recording_info import recording_digest, recording_info
from replay.events import Event
from replay.mcap.encoding import decode, encode
from replay.mcap.foxglove_messages import FOXGLOVE
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover
from replay.mcap.schemas import RECORDS
from tests.tools.mutations import (
    changed_messages,
    file_of,
    joined,
    packed,
    split,
    topics_of,
    unpacked,
)
from tests.tools.seals import reseal_file
from tests.tools.small_recordings import registered_session, robot_session, write_recording

Change = Callable[[str, bytes], bytes | None]


def edited(**values: Any) -> Change:
    """Other values of fields of a message of the project's own; a function gets the old one."""

    def change(topic: str, data: bytes) -> bytes:
        old = decode(RECORDS[topic], data)
        new = {name: of(old[name]) if callable(of) else of for name, of in values.items()}
        return encode(RECORDS[topic], old | new)

    return change


def dropped(topic: str, data: bytes) -> None:
    return None


def longer(topic: str, data: bytes) -> bytes:
    """The same message with a field that no reader looks at."""
    return data + b"\xfa\x3e\x03new"  # field 1007


def smaller_error(values: dict[str, float]) -> dict[str, float]:
    return {n: value / 2 if "position_error" in n else value for n, value in values.items()}


smaller_errors, opposite_normals = edited(values=smaller_error), edited(contact_normals=np.negative)
AT_THE_START = ("/session", "/rig", "/object_pose")
IN_A_STEP = (
    *("/sensor_image", "/probe", "/points/free", "/points/known", "/known_points", "/gripper_path"),
    *("/problem", "/trace", "/archive", "/hypotheses", "/hypothesis_poses", "/hypothesis_surfaces"),
    *("/measured", "/log", "/all_points/free/0"),
)
STEPS = {**dict.fromkeys(AT_THE_START, -1), **dict.fromkeys(IN_A_STEP, 0), "/session_ended": 1}
"""A step of each topic that the session uses."""
TAMPERED: list[tuple[str, int, Change]] = [
    *((topic, step, change) for topic, step in STEPS.items() for change in (longer, dropped)),
    ("/measured", 1, smaller_errors),
    ("/probe", 0, opposite_normals),
    ("/session", -1, edited(config=lambda text: '{"b": 1,' + text[1:])),
    ("/session", -1, edited(environment={"numpy": "9"})),
    ("/sensor_image", 1, edited(unit=0.002)),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A session of a robot with two registrations, in which nearly all topics are used."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    data = write_recording(path, robot_session("chsel"))
    assert [verdict.outcome for verdict in verify(read_recording(path))] == [EQUAL, EQUAL]
    return data


def with_change(path: Path, whole: bytes, topic: str, step: int, change: Change) -> Path:
    """The file with one message of a step changed."""
    everything, done = split(whole[8:-8]), []

    def change_once(found: str, _: int, data: bytes) -> bytes | None:
        if found != topic or done or step_of(found, data) != step:
            return data
        done.append(change(found, data))
        return done[0]

    path.write_bytes(file_of(changed_messages(everything, topics_of(everything), change_once)))
    assert len(done) == 1
    return path


def step_of(topic: str, data: bytes) -> int:
    if topic == "/contents":
        return -1
    if topic in RECORDS:
        return int(decode(RECORDS[topic], data).get("step", -1))
    message: Any = FOXGLOVE[topic].FromString(data)
    return int(message.timestamp.seconds) - 1


@pytest.mark.parametrize(("topic", "step", "change"), TAMPERED)
def test_what_was_changed_is_named(
    whole: bytes,
    tmp_path: Path,
    topic: str,
    step: int,
    change: Change,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = with_change(tmp_path / "a.mcap", whole, topic, step, change)
    where = "the session's start" if step < 0 else f"step {step}"
    assert main(["verify", str(path)]) == 2
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert f"{topic} was changed after it was written, in {where}" in shown.err or (
        change is dropped and f"{topic} is missing after it was written, in {where}" in shown.err
    )
    assert f"`python -m replay recover {path} -o OUT`" in shown.err
    assert main(["info", str(path), "--check"]) in (1, 2)
    shown = capsys.readouterr()
    text = " ".join((shown.out + shown.err).split())
    assert topic in text
    assert f"after it was written, in {where}" in text
    with pytest.raises(RecordingError, match=f"{topic} "):
        read_recording(path)


@pytest.mark.parametrize(("topic", "step", "change"), TAMPERED)
def test_all_seals_made_again_give_another_digest(
    whole: bytes, tmp_path: Path, topic: str, step: int, change: Change
) -> None:
    """Nothing in the file tells then; the digest that was noted elsewhere does."""
    path = with_change(tmp_path / "a.mcap", whole, topic, step, change)
    reseal_file(path)
    (tmp_path / "whole.mcap").write_bytes(whole)
    file_digest = recording_digest(tmp_path / "whole.mcap")
    assert file_digest == read_recording(tmp_path / "whole.mcap").digest
    assert len(str(file_digest)) == 32
    try:
        digest = read_recording(path).digest
    except RecordingError:
        return
    assert digest != file_digest


@pytest.mark.parametrize("place", ["chunk", "summary"])
def test_a_changed_schema_is_named(whole: bytes, tmp_path: Path, place: str) -> None:
    everything = split(whole[8:-8])
    found = next(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK)
    if place == "summary":
        found = next(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.SCHEMA)
        everything[found] = (Opcode.SCHEMA, everything[found][1][:-1] + b"x")
        message = r"in its summary, schema \d+ is described twice, and not the same"
    else:
        inside = split(unpacked(everything[found][1]))
        inside[0] = (inside[0][0], inside[0][1][:-1] + b"x")
        everything[found] = (Opcode.CHUNK, packed(joined(inside)))
        message = "a schema or channel was changed after it was written, in the session's start"
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(everything))
    with pytest.raises(RecordingError, match=message):
        read_recording(path)


def test_a_step_left_out_is_named(whole: bytes, tmp_path: Path) -> None:
    everything = split(whole[8:-8])
    chunks = [i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK]
    assert len(chunks) == 5  # the start, the rig, two steps, the end
    without = [part for i, part in enumerate(everything) if i != chunks[2]]
    numbered = changed_messages(without, topics_of(everything), lambda topic, number, data: data)
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(numbered))
    with pytest.raises(RecordingError, match=r"order or times of messages was changed .* step 1"):
        read_recording(path)


@pytest.mark.parametrize(
    ("chunk", "step", "message"),
    [
        (2, 0, "step 1 does not follow the step before it, which was changed"),
        (3, 1, "step 1 does not follow the step before it, which was changed"),
        (4, 1, "its contents have another digest than its last step"),
    ],
)
def test_one_seal_made_again_does_not_fit_the_next(
    whole: bytes, tmp_path: Path, chunk: int, step: int, message: str
) -> None:
    """A changed step with a right seal of its own, and all other seals as they were."""
    topic, change = ("/session_ended", longer) if chunk == 4 else ("/probe", opposite_normals)
    path = with_change(tmp_path / "a.mcap", whole, topic, step, change)
    changed, original = split(reseal_file(path).read_bytes()[8:-8]), split(whole[8:-8])
    place = [i for i, (opcode, _) in enumerate(original) if opcode == Opcode.CHUNK][chunk]
    if chunk == 4:  # the contents are as they were as well
        inside, last = (split(unpacked(part[place][1])) for part in (changed, original))
        original[place] = (Opcode.CHUNK, packed(joined([*inside[:-1], last[-1]])))
    else:
        original[place] = changed[place]
    path.write_bytes(file_of(original))
    with pytest.raises(RecordingError, match=message):
        read_recording(path)


@pytest.mark.parametrize(
    ("topic", "values", "message"),
    [
        ("/seal", {"digest": "0" * 32}, "the seal of step 1 was changed after it was written"),
        ("/seal", {"previous": ""}, "step 1 does not follow the step before it"),
        ("/seal", {"session": "0" * 32}, "step 1 belongs to another recording"),
        ("/contents", {"session": "0" * 32}, "its contents belong to another recording"),
        ("/contents", {"digest": ""}, "its contents have another digest than its last step"),
        ("/contents", {"free": lambda free: free + 1}, "its contents, as read, have another free"),
    ],
)
def test_seals_and_contents_are_compared(
    whole: bytes, tmp_path: Path, topic: str, values: dict[str, Any], message: str
) -> None:
    step = 1 if topic == "/seal" else -1
    path = with_change(tmp_path / "a.mcap", whole, topic, step, edited(**values))
    with pytest.raises(RecordingError, match=message):
        read_recording(path)


def test_the_time_of_the_contents_is_compared(whole: bytes, tmp_path: Path) -> None:
    everything = split(whole[8:-8])
    place = max(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK)
    inside = split(unpacked(everything[place][1]))
    head = bytearray(inside[-1][1])
    head[6] ^= 1  # of its log time
    inside[-1] = (inside[-1][0], bytes(head))
    everything[place] = (Opcode.CHUNK, packed(joined(inside)))
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(everything))
    with pytest.raises(RecordingError, match="the time of its contents was changed"):
        read_recording(path)


@pytest.mark.parametrize("how", ["no seal at all", "a step without a seal"])
def test_messages_without_a_seal_are_refused(whole: bytes, tmp_path: Path, how: str) -> None:
    everything = split(whole[8:-8])
    topics, seen = topics_of(everything), []

    def without_seals(topic: str, number: int, data: bytes) -> bytes | None:
        if topic == "/contents" and how == "no seal at all":
            return encode("Contents", decode("Contents", data) | {"session": "", "digest": ""})
        if topic == "/seal":
            seen.append(number)
            return None if how == "no seal at all" or len(seen) == 5 else data
        return data

    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(changed_messages(everything, topics, without_seals)))
    assert len(seen) == 5
    message = "has no seals" if how == "no seal at all" else "its contents have another digest"
    with pytest.raises(RecordingError, match=message):
        read_recording(path)


def test_an_attachment_behind_the_last_seal_is_refused(whole: bytes, tmp_path: Path) -> None:
    everything = split(whole[8:-8])
    end = next(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.DATA_END)
    body = bytes(16) + b"\5\0\0\0extra" + bytes(4) + bytes(8)
    everything.insert(end, (Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body))))
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(everything))
    with pytest.raises(RecordingError, match="records follow its last seal"):
        read_recording(path)


def test_wrong_numbers_under_right_seals_are_named_by_verify(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = write_recording(tmp_path / "whole.mcap", registered_session("gradient_descent"))
    path = with_change(tmp_path / "a.mcap", whole, "/measured", 1, smaller_errors)
    assert recording_info(reseal_file(path), check=True).damage is None
    verdicts = list(verify(read_recording(path)))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL, DIFFERS]
    assert verdicts[1].stage == "the measured values"
    lines = [line.split(":")[0] for line in verdicts[1].differences]
    assert lines == ["measured best_position_error", "measured closest_position_error"]
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "step 1, gradient_descent: differs" in shown
    assert "first difference: the measured values" in shown
    missing = with_change(tmp_path / "b.mcap", whole, "/measured", 1, dropped)
    found = list(verify(read_recording(reseal_file(missing))))
    assert found[1].differences == ("there are 0 messages of measured values; accepted: one",)


def test_numbers_may_differ_as_libraries_round_and_no_more(tmp_path: Path) -> None:
    whole = write_recording(tmp_path / "whole.mcap", registered_session("gradient_descent"))
    for factor, outcome in ((1 + 1e-13, EQUAL), (1 + 1e-7, DIFFERS)):

        def nudged(values: dict[str, float], by: float = factor) -> dict[str, float]:
            return {name: value * by for name, value in values.items()}

        path = tmp_path / f"{outcome}.mcap"
        with_change(path, whole, "/measured", 0, edited(values=nudged))
        verdicts = list(verify(read_recording(reseal_file(path))))
        assert verdicts[0].outcome == outcome


def test_the_digest_of_a_recording_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, registered_session("gradient_descent"))
    digest = read_recording(path).digest
    assert main(["verify", str(path)]) == 0
    assert capsys.readouterr().out.endswith(f" s, digest {digest}\n")
    assert main(["info", str(path)]) == 0
    assert f"digest       {digest}" in capsys.readouterr().out


def test_recover_leaves_out_what_was_changed(whole: bytes, tmp_path: Path) -> None:
    path = with_change(tmp_path / "a.mcap", whole, "/measured", 1, smaller_errors)
    found = recover(path, tmp_path / "out.mcap")
    assert (found.probes, found.lost_probes) == ([0], [(1, 1)])
    assert any("/measured was changed" in damage.reason for damage in found.damages)
    events: list[Event] = list(read_recording(tmp_path / "out.mcap").events())
    assert max(getattr(event, "step", -1) for event in events) <= 1


def test_pose_errors_may_differ_by_a_tenth_of_a_millimetre_and_nothing_else_may() -> None:
    assert is_close(0.01, 0.01 + 0.9e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1.1e-4, "best_position_error")
    assert not is_close(0.01, 0.01 + 1e-6, "archive_coverage")
