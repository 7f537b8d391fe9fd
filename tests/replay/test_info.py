"""What `info` says about a recording, and about MCAP files of other programs."""

from __future__ import annotations

import json

import pytest
from mcap.reader import make_reader

from replay.__main__ import main
from replay.events import HypothesesFound, ProblemPosed
from replay.verbs.info import is_other_programs, log_info, recording_info
from tests.runners.sensors.small_logs import BEGIN, SECOND, ros2_sent, write_ros2


def test_info_tells_what_the_session_was(events, write):
    path = write(events)
    info = recording_info(path)
    assert (info["object"], info["seed"]) == ("Bohrmaschine ½″ 电钻", 2**64 - 1)
    assert info["config"]["flags"] == [True, None, -1, 1e-300]
    found = (info["bytes"], info["outcome"], info["registrations"])
    assert found == (path.stat().st_size, "finished", 2)
    costs = [event.hypotheses.cost[0] for event in events if isinstance(event, HypothesesFound)]
    assert [list(row.values()) for row in info["steps"]] == [
        [0, 80, 2, 0, 0, False, None, None, None],
        [1, 120, 4, 2, 1, True, 5, 3, costs[0]],
        [2, 160, 6, 6, 3, True, 5, 3, costs[1]],
    ]
    assert info["integrity"] == {"whole": True, "damage": None}


def test_messages_are_counted_with_their_bytes(any_events, write):
    path = write(any_events)
    info = recording_info(path)
    with path.open("rb") as file:
        stored = [(c.topic, len(m.data)) for _, c, m in make_reader(file).iter_messages()]
    assert sum(info["message_bytes"].values()) == sum(size for _, size in stored)
    topics = [topic for topic, _ in stored]
    assert info["messages"] == {topic: topics.count(topic) for topic in topics}


def test_what_is_not_whole_is_told(events, write, capsys):
    path = write(events)
    path.write_bytes(path.read_bytes()[:-1])
    assert main(["info", str(path)]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "unfinished; what is whole was read, and `python -m replay recover" in shown
    posed = next(event for event in events if isinstance(event, ProblemPosed))
    vars(posed.problem)["digest"] = "0" * 32
    assert main(["info", str(write(events))]) == 1
    assert "the problem of step 1 has digest" in " ".join(capsys.readouterr().out.split())


def test_a_problem_without_a_result_counts_as_no_registration(events, write, capsys):
    path = write([e for e in events if not (isinstance(e, HypothesesFound) and e.step == 2)])
    assert recording_info(path)["registrations"] == 1
    assert main(["info", str(path)]) == 0
    assert "no result" in capsys.readouterr().out


def test_json_is_standard_and_a_list_of_several(events, write, tmp_path, capsys):
    path, log, other = write(events), tmp_path / "log.mcap", tmp_path / "other.mcap"
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"][0]["best_cost"] is None
    write_ros2(log, ros2_sent())
    other.write_bytes(b"no recording")
    assert main(["info", str(path), str(log), str(other), "--json"]) == 2
    shown = capsys.readouterr()
    recording, of_log, failed = json.loads(shown.out)
    assert recording["message_bytes"]["/probe"] > 0
    assert {topic["topic"] for topic in of_log["topics"]} >= {"/tf", "/depth"}
    assert "is not an MCAP file; accepted: " in failed["error"]
    assert shown.err.startswith("error: recording")
    assert shown.err.count("\n") == 1


def test_topics_types_counts_and_rates_of_a_log(tmp_path, capsys):
    path = tmp_path / "log.mcap"
    whole = write_ros2(path, ros2_sent(9), chunk_size=1500)
    assert is_other_programs(path)
    info = log_info(path)
    assert len(info["topics"]) == 15
    assert sum(topic["count"] for topic in info["topics"]) == 9 * 15
    assert (info["begin"], info["end"]) == (BEGIN + 10**6, BEGIN + 8 * SECOND + 10**6)
    assert next(topic for topic in info["topics"] if topic["topic"] == "/depth") == {
        "topic": "/depth",
        "type": "sensor_msgs/msg/Image",
        "encoding": "cdr",
        "count": 9,
        "rate": pytest.approx(9.0 / 8.0),
    }
    path.write_bytes(whole[: len(whole) // 3])
    assert 0 < sum(topic["count"] for topic in log_info(path)["topics"]) < 9 * 15
    assert main(["info", str(path)]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "unfinished or damaged: log.mcap: a record is cut short; what is whole" in output


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("none.mcap", None, "does not exist; accepted: "),
        ("x.mcap", b"\x89MCAP0\r\n\x01", "has no session in it"),
        ("x.bag", b"#ROSBAG V2.0\n", "`rosbags-convert --src LOG.bag"),
    ],
)
def test_what_is_no_log_is_an_error_of_one_line(tmp_path, capsys, name, data, message):
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    assert main(["info", str(path)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
