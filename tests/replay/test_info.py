"""What `info` tells of a recording, from how little, and of what kind of file."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from chsel.errors import RecordingError
from replay.__main__ import main
from replay.content.recording_info import recording_info
from replay.events import Event, HypothesesFound, Probe, ProblemPosed
from replay.mcap.writer import McapRecorder

REPOSITORY = Path(__file__).resolve().parents[2]
ROW = r"(?m)^ +(\d+) +\d+ +\d+ +\d+ +\d+ "  # of the table of steps


@pytest.fixture
def write_steps(tmp_path: Path) -> Callable[[list[Event]], Path]:
    """Records events as a run does: with a chunk for every step."""

    def record(events: list[Event]) -> Path:
        path = tmp_path / f"steps{len(list(tmp_path.iterdir()))}.mcap"
        recorder = McapRecorder(path)
        for event in events:
            if isinstance(event, Probe):
                recorder.flush()
            recorder.record(event)
        recorder.close()
        return path

    return record


def strict_json(text: str):
    """The values of standard JSON."""

    def refuse(name: str):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_info_tells_what_the_session_was(events, write_steps):
    path = write_steps(events)
    info = recording_info(path)
    assert info.session["object"] == "Bohrmaschine ½″ 电钻"
    assert info.session["seed"] == 2**64 - 1
    assert info.session["environment"]["torch"] == "2.13.0"
    assert info.session["config"] == {
        "object": {"name": "电钻", "scale": 1.5},
        "flags": [True, None, -1, 1e-300],
    }
    assert (info.size, info.outcome, info.registrations) == (path.stat().st_size, "finished", 2)
    assert [step["step"] for step in info.steps] == [0, 1, 2]
    assert [step["free"] for step in info.steps] == [80, 120, 160]
    assert [step["occupied"] for step in info.steps] == [2, 4, 6]
    assert [step["known"] for step in info.steps] == [0, 2, 6]
    assert [step["contacts"] for step in info.steps] == [0, 1, 3]
    assert [step["posed"] for step in info.steps] == [False, True, True]
    assert [step["hypotheses"] for step in info.steps] == [-1, 5, 5]
    assert [step["distinct"] for step in info.steps] == [-1, 3, 3]
    found = [event for event in events if hasattr(event, "hypotheses")]
    best = [event.hypotheses.cost[0] for event in found]
    assert [step["best_cost"] for step in info.steps[1:]] == best
    assert info.damage is None


def test_messages_are_counted_with_their_bytes(any_events, write_steps):
    path = write_steps(any_events)
    info = recording_info(path)
    with path.open("rb") as file:
        stored = [
            (channel.topic, len(m.data)) for _, channel, m in make_reader(file).iter_messages()
        ]
    assert sum(info.message_bytes.values()) == sum(size for _, size in stored)
    assert info.messages == {
        topic: sum(topic == name for name, _ in stored) for topic in {name for name, _ in stored}
    }


def test_what_is_whole_of_an_unfinished_file_is_told(events, write_steps, capsys):
    path = write_steps(events)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    info = recording_info(path)
    assert info.damage == "unfinished"
    assert info.outcome is None
    assert len(info.steps) < 3
    assert main(["info", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "unfinished; what is whole was read, and `python -m replay recover" in shown
    assert "the session did not end" in shown


def test_another_programs_file_is_refused(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "")
        channel = writer.register_channel("/session", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(RecordingError, match="is another program's"):
        recording_info(path)


def test_a_problem_that_contradicts_the_points_is_found_by_checking(events, write, capsys):
    posed = next(event for event in events if isinstance(event, ProblemPosed))
    vars(posed.problem)["digest"] = "0" * 32
    path = write(events)
    assert "the problem of step 1 has digest" in recording_info(path).damage
    assert main(["info", str(path)]) == 1
    assert "the problem of step 1 has digest" in " ".join(capsys.readouterr().out.split())


def test_a_problem_without_a_result_counts_as_no_registration(events, write, capsys):
    cut = [e for e in events if not (isinstance(e, HypothesesFound) and e.step == 2)]
    path = write(cut)
    assert recording_info(path).registrations == 1
    assert main(["info", str(path)]) == 0
    assert "no result" in capsys.readouterr().out


def test_json_is_standard_and_a_list_of_several(events, write, tmp_path, capsys):
    path = write(events)
    assert main(["info", str(path), "--json"]) == 0
    single = strict_json(capsys.readouterr().out)
    assert single["steps"][0]["best_cost"] is None
    assert single["integrity"] == {"whole": True, "damage": None}
    other = tmp_path / "other.mcap"
    other.write_bytes(b"no recording")
    assert main(["info", str(path), str(other), "--json"]) == 2
    shown = capsys.readouterr()
    several = strict_json(shown.out)
    assert several[0]["message_bytes"]["/probe"] > 0
    assert "is not an MCAP file; accepted: " in several[1]["error"]
    assert shown.err.startswith("error: recording")
    assert shown.err.count("\n") == 1


def test_of_many_files_each_is_a_line(events, write, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    paths = [str(write(events)) for _ in range(4)]
    cut = Path(paths[-1])
    cut.write_bytes(cut.read_bytes()[:-1])
    assert main(["info", *paths]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert sum("whole" in line for line in lines) == 3
    assert sum("unfinished" in line for line in lines) == 1
    assert all("best cost" not in line for line in lines)


def test_of_many_steps_the_first_and_last_are_shown(make_events, write, capsys):
    path = str(write(make_events(steps=20, elites=1, free=1)))
    assert main(["info", path]) == 0
    few = capsys.readouterr().out
    assert "10 more steps (--steps shows all)" in few
    assert main(["info", path, "--steps"]) == 0
    every = capsys.readouterr().out
    assert "more steps" not in every
    shown = [[int(row[1]) for row in re.finditer(ROW, text)] for text in (few, every)]
    assert shown == [[0, 1, 2, 3, 4, 15, 16, 17, 18, 19], list(range(20))]


def test_files_that_cannot_be_used_are_named(tmp_path, capsys):
    assert main(["info", str(tmp_path / "nowhere.mcap")]) == 2
    assert "nowhere.mcap does not exist; accepted: " in capsys.readouterr().err
    assert main(["info", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
