"""Which time belongs to which probe."""

from __future__ import annotations

import pytest

from runners.sensors.log.clocks import SLACK, ClockCorrection, in_time_order
from runners.sensors.log.messages import MarkerMessage, Received
from runners.sensors.log.probe_windows import marked_windows
from runners.sensors.log.transforms import MOST_OF_A_PROBE, JointHistory
from runners.sensors.session_report import LogWarnings


def spans(*texts: str) -> tuple[list[tuple[int, int, int, int, int]], list[str]]:
    """Windows of markers at times 10, 20, ... in a log from 0 to 100, and the warnings."""
    warnings = LogWarnings()
    markers = [(10 * (index + 1), text) for index, text in enumerate(texts)]
    windows = marked_windows(reversed(markers), 0, 100, warnings)
    found = [(w.step, w.opens, w.begin, w.end, w.closes) for w in windows]
    return found, [text for _, text in warnings.lines()]


def test_a_window_reaches_to_the_next_begin_and_the_first_one_to_the_start() -> None:
    found, said = spans("begin 0", "end 0", " Begin 1", "END 1")
    assert found == [(0, 0, 10, 20, 30), (1, 30, 30, 40, 101)]
    assert said == []


@pytest.mark.parametrize(
    "texts",
    [
        ("4", "4", "4", "-1", "-1", "7", "7", "-1"),
        ("false", "true", "true", "false", "false", "true", "true", "false"),
    ],
)
def test_states_that_are_sent_all_the_time_say_nothing_new(texts: tuple[str, ...]) -> None:
    found, said = spans(*texts)
    assert said == []
    assert [(end - begin) % 10 for _, _, begin, end, _ in found] == [0, 0]
    assert [step for step, *_ in found] == ([4, 7] if texts[0] == "4" else [0, 1])


def test_a_change_of_number_ends_a_probe() -> None:
    found, said = spans("0", "0", "1", "-5")
    assert (found, said) == ([(0, 0, 10, 30, 30), (1, 30, 30, 40, 101)], [])


def test_begins_without_number_are_counted() -> None:
    found, said = spans("begin", "begin", "end")
    assert [step for step, *_ in found] == [0, 1]
    assert said == ["a probe has a begin and no end; the next begin ends it"]


def test_marks_that_do_not_fit_are_reported() -> None:
    found, said = spans("end 9", "begin 2", "hello", "begin 2", "begin 1")
    assert found == [(0, 0, 20, 50, 50), (1, 50, 50, 100, 101)]
    assert said == [
        "probe 9 has an end and no begin; ignored",
        "a marker is 'hello'; accepted: begin N, end",
        "probe 2 begins twice without an end; taken as one",
        "probe 2 has a begin and no end; the next begin ends it",
        "probe 1 has a begin and no end; the log's end ends it",
        "probes are marked 2, 1; as these do not rise, they are counted from 0 to 1",
    ]


def test_messages_come_in_the_order_of_their_times_if_they_are_not_too_late() -> None:
    stamps = [3, 1, 2, 9, 5, 4, 30, 0]  # the last one comes long after its place
    logged = [0, 0, 0, 1, 1, 1, 3 * SLACK, 3 * SLACK]
    messages = [
        Received("/t", log, stamp, MarkerMessage(""))
        for log, stamp in zip(logged, stamps, strict=True)
    ]
    got = [time for time, _ in in_time_order(messages, lambda message: message.stamp or 0)]
    assert got == [1, 2, 3, 4, 5, 9, 0, 30]


def history(*positions: dict[str, float]) -> JointHistory:
    """Positions at times 0, 10, 20, ..."""
    joints = JointHistory(["finger"])
    for index, values in enumerate(positions):
        joints.add(Received("/joints", 10 * index, None, MarkerMessage("")), values)
    joints.settle(ClockCorrection())
    return joints


def test_a_state_of_the_joints_holds_until_the_next() -> None:
    moved = [0.1 if time >= 500 else 0.001 * (time % 20) for time in range(0, 1000, 10)]
    joints = history(*({"finger": value, "elbow": 10.0 * n} for n, value in enumerate(moved)))
    assert joints.first() == {"finger": 0.0}
    assert joints.during(100, 400) == [(100, {"finger": 0.0})]
    assert joints.during(400, 600) == [(400, {"finger": 0.0}), (500, {"finger": 0.1})]
    assert joints.during(600, 700) == [(600, {"finger": 0.1})]
    assert history().during(0, 9) == [(0, {})]
    busy = history(*({"finger": float(time)} for time in range(1000)))
    assert len(busy.during(0, 10_000)) <= MOST_OF_A_PROBE
