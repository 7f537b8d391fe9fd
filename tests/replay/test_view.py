"""`replay view` and `replay info`: viewers, web pages, sessions and foreign logs."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from rerun.blueprint.components import PlayState

from chsel.events import HypothesesFound, Probe, ProblemPosed, Timed
from replay.__main__ import main
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import RerunRecorder
from replay.verbs.info import is_other_programs, log_info, recording_info
from tests.replay.conftest import with_decisions
from tests.runners.sensors.small_logs import BEGIN, SECOND, ros2_sent, write_ros2
from tests.tools.rrd_rows import opens_at, read, views_of_the_last_layout

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def test_what_is_saved_is_what_a_session_draws(sensor_events, tmp_path, write, capsys):
    """All kinds of events, drawn as they come, and read back."""
    events = with_decisions(sensor_events)
    events.insert(-1, Timed(events[-1].step, {"registration": 0.5}))
    drawn, saved = tmp_path / "drawn.rrd", tmp_path / "saved.rrd"
    recorder = RerunRecorder(drawn)
    for event in events:
        if isinstance(event, Probe):
            recorder.flush()
        recorder.record(event)
    recorder.close()
    assert main(["view", str(write(events)), "--save", str(saved)]) == 0
    assert capsys.readouterr().out.strip() == str(saved)
    rows = read(saved)
    np.testing.assert_equal(rows, read(drawn))
    assert len(rows["/scene/hypotheses/best"]) > 2
    assert views_of_the_last_layout(saved) == views_of_the_last_layout(drawn)


def test_nothing_after_the_step_asked_for_is_saved(events, tmp_path, write, capsys):
    file = str(write(events))
    saved = tmp_path / "saved.rrd"
    assert main(["view", file, "--save", str(saved), "--step", "7"]) == 2
    assert "there is no step 7; accepted: 0, 1, 2" in capsys.readouterr().err
    assert not saved.exists()
    assert main(["view", file, "--save", str(saved), "--step", "1"]) == 0
    probes = {times.get("probe", 0) for rows in read(saved).values() for times, _ in rows}
    assert max(probes) == 1
    assert opens_at(saved) == ("probe", PlayState.Following)  # at that probe, the last


def test_without_a_viewer_the_reason_is_told(events, tmp_path, write, monkeypatch, capsys):
    file = str(write(events))
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":  # elsewhere there always is a screen
        assert main(["view", file]) == 2
        error = capsys.readouterr().err
        assert "there is no screen" in error
        assert "accepted: --save OUT.rrd, or --web" in error
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\necho no graphics today\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr(rerun_viewer, "viewer_program", lambda: program)
    monkeypatch.setenv("DISPLAY", ":99")
    assert main(["view", file]) == 2
    assert "the Rerun viewer does not start: no graphics today" in capsys.readouterr().err


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(("ending", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_web_viewer_is_served_here_alone_and_ends_with_the_command(
    events, tmp_path, write, ending, status
):
    folder = tmp_path / "temporary"
    folder.mkdir()
    command = [sys.executable, "-m", "replay", "view", str(write(events)), "--web"]
    environment = {name: value for name, value in os.environ.items() if name not in SCREENS}
    environment |= {"TMPDIR": str(folder), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as viewing:
        try:
            address = viewing.stdout.readline().strip()
            page, data = map(int, re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address))
            with urllib.request.urlopen(f"http://127.0.0.1:{page}/") as answer:
                assert b"<html" in answer.read()
            assert rerun_viewer.is_listening(data)
            assert [file.name for file in folder.rglob("*.rrd")] == ["recording.rrd"]
            viewing.send_signal(ending)
            assert viewing.wait(600) == status
        finally:
            viewing.kill()  # else the block would wait for one that a failure has left behind
    assert not rerun_viewer.is_listening(page)
    assert not rerun_viewer.is_listening(data)
    assert list(folder.iterdir()) == []


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
        ("x.bag", b"#ROSBAG V2.0\n", "cannot be read as a ROS 1 bag"),
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
