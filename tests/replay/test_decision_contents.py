"""Decisions in `info`, `export`, `diff`, and in what `recover` saves."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from replay.__main__ import main
from replay.events import Decided, Event, Probe
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover
from replay.mcap.viewer_messages import next_probe
from replay.mcap.writer import McapRecorder
from replay.verbs.info import recording_info
from tests.replay.conftest import same_bits
from tests.replay.mcap.test_recovery import chunks_of

Write = Callable[[list[Event]], Path]


@pytest.fixture
def decisions(steered_events: list[Event]) -> list[Decided]:
    return [event for event in steered_events if isinstance(event, Decided)]


def flushed(path: Path, events: list[Event]) -> bytes:
    """A recording with a chunk for each decision, and one for each probe with its results."""
    recorder = McapRecorder(path)
    for event in events:
        if isinstance(event, Probe | Decided):
            recorder.flush()
        recorder.record(event)
    recorder.close()
    return path.read_bytes()


def test_info_names_the_policy_and_how_it_stopped(
    steered_events: list[Event],
    events: list[Event],
    write: Write,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = write(steered_events)
    last = read_recording(path).decision(2).decision
    expected = {"name": "dice", "stop": "spread", "spread": last.spread}
    assert recording_info(path)["policy"] == expected
    assert main(["info", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    spread = f"{1000.0 * last.spread:.1f} mm"
    assert f"policy dice, decisions 4, stopped by spread, spread of the poses {spread}" in shown
    cut = [e for e in steered_events if not isinstance(e, Decided) or e.step < 2]
    unknown = {"name": "dice", "stop": None, "spread": None}
    assert recording_info(write(cut))["policy"] == unknown
    assert recording_info(write(events))["policy"] is None


def test_decisions_are_exported_in_three_forms(
    steered_events: list[Event], decisions: list[Decided], write: Write, tmp_path: Path
) -> None:
    path = str(write(steered_events))
    outs = {name: tmp_path / f"out.{name}" for name in ("csv", "json", "npz")}
    for out in outs.values():
        assert main(["export", path, "--what", "decisions", "-o", str(out)]) == 0
    rows = list(csv.DictReader(outs["csv"].open(newline="")))
    listed = json.loads(outs["json"].read_text())
    arrays = np.load(outs["npz"])
    assert arrays["steps"].tolist() == [-1, 0, 1, 2]
    for row, same, event in zip(rows, listed, decisions, strict=True):
        made, chosen = event.decision, event.decision.chosen
        assert (int(row["step"]), row["policy"], row["stop"]) == (event.step, "dice", made.stop)
        assert (float(row["spread"]), float(row["surprise"])) == (made.spread, event.surprise)
        assert int(row["chosen"]) == same["chosen"] == chosen
        if chosen >= 0:
            assert float(row["expected_spread"]) == made.expected_spread[chosen]
            pose = event.problem.actions.world_from_hand[chosen]
            assert [float(row[name]) for name in ("dx", "dy", "dz")] == pose[:3, 2].tolist()
        else:
            assert row["x"] == row["score"] == ""
            assert same["x"] is None
        for name in ("score", "contacts", "hit_chance"):
            assert same_bits(arrays[f"step_{event.step}/{name}"], getattr(made, name))
        assert same_bits(arrays[f"step_{event.step}/poses"], event.problem.belief.object_from_world)


def test_diff_names_the_number_that_differs(
    steered_events: list[Event],
    decisions: list[Decided],
    write: Write,
    capsys: pytest.CaptureFixture[str],
) -> None:
    score = decisions[1].decision.score.copy()
    score[3] = np.nextafter(score[3], 9.0)
    other = dataclasses.replace(decisions[1].decision, score=score)
    changed = dataclasses.replace(decisions[1], decision=other)
    events = [changed if event is decisions[1] else event for event in steered_events]
    assert main(["diff", str(write(steered_events)), str(write(events))]) == 1
    shown = capsys.readouterr().out
    assert "/decision" in shown
    assert "score: 1 of 4 numbers by up to 1 ulp" in shown


def recovered(path: Path, data: bytes) -> tuple[list[Event], dict[str, str]]:
    """Events that a damaged file gives, and what is lost."""
    out = path.with_name("recovered.mcap")
    path.write_bytes(data)
    found = recover(path, out)
    return list(read_recording(out).events()), found.lost


def test_a_lost_decision_takes_nothing_else_with_it(
    steered_events: list[Event], tmp_path: Path
) -> None:
    path = tmp_path / "damaged.mcap"
    data = bytearray(flushed(path, steered_events))
    start, end = chunks_of(bytes(data), "/decision")[1]
    data[start + 40 : end - 40] = bytes(end - start - 80)
    events, lost = recovered(path, bytes(data))
    assert [event.step for event in events if isinstance(event, Decided)] == [-1, 1, 2]
    assert list(lost) == [f"bytes {start} to {end}", *[k for k in lost if "messages before" in k]]
    kept = [event for event in events if isinstance(event, Probe)]
    assert all(map(same_bits, kept, (e for e in steered_events if isinstance(e, Probe))))
    assert len(kept) == 3


def test_a_file_that_ends_within_a_decision_gives_those_before(
    steered_events: list[Event], tmp_path: Path
) -> None:
    path = tmp_path / "damaged.mcap"
    data = flushed(path, steered_events)
    start, end = chunks_of(data, "/decision")[2]
    events, _ = recovered(path, data[: (start + end) // 2])
    assert [event.step for event in events if isinstance(event, Decided)] == [-1, 0]
    assert [event.step for event in events if isinstance(event, Probe)] == [0, 1]


def test_a_decision_behind_a_lost_probe_is_not_believed(
    steered_events: list[Event], tmp_path: Path
) -> None:
    path = tmp_path / "damaged.mcap"
    data = bytearray(flushed(path, steered_events))
    start, end = chunks_of(bytes(data), "/probe")[1]
    data[start + 40 : end - 40] = bytes(end - start - 80)
    events, lost = recovered(path, bytes(data))
    assert [event.step for event in events if isinstance(event, Decided)] == [-1, 0]
    assert {"/decision of step 1", "/decision of step 2"} <= set(lost)


def test_viewers_get_an_arrow_from_start_to_end(decisions: list[Decided]) -> None:
    first, last = decisions[0], decisions[-1]
    (entity,) = SceneUpdate.FromString(next_probe(first, 5)).entities
    (arrow,) = entity.arrows
    pose = first.problem.actions.world_from_hand[first.decision.chosen]
    position: Any = arrow.pose.position
    assert np.allclose([position.x, position.y, position.z], pose[:3, 3])
    q = arrow.pose.orientation
    along = [
        1.0 - 2.0 * (q.y**2 + q.z**2),
        2.0 * (q.x * q.y + q.w * q.z),
        2.0 * (q.x * q.z - q.w * q.y),
    ]
    assert np.allclose(along, pose[:3, 2])
    length = first.problem.actions.length[first.decision.chosen]
    assert np.isclose(arrow.shaft_length + arrow.head_length, length)
    (entity,) = SceneUpdate.FromString(next_probe(last, 5)).entities
    assert len(entity.arrows) == 0
