"""Clocks that disagree: which topics are shifted, and what is told of it."""

import numpy as np

from runners.sensors.log.clocks import Clocks
from runners.sensors.log.messages import MarkerMessage, Received, TransformMessage
from runners.sensors.rig import ClockRig

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
TEXT = MarkerMessage("x")


def received(topic: str, time: float, stamp: float | None) -> Received:
    """A message at seconds since BEGIN."""
    sent = None if stamp is None else BEGIN + round(stamp * SECOND)
    return Received(topic, BEGIN + round(time * SECOND), sent, TEXT)


def gathered(offsets: dict[str, float], rig: ClockRig | None = None) -> Clocks:
    """Eleven messages a topic, whose stamps are off by so many seconds and some milliseconds."""
    clocks, random = Clocks(rig or ClockRig()), np.random.default_rng(0)
    for time in range(11):
        for topic, offset in offsets.items():
            clocks.add(received(topic, time, time + offset - 0.01 * random.random()))
    return clocks


def seconds(nanoseconds: float) -> float:
    return nanoseconds / SECOND


def test_clocks_that_agree_are_left_alone() -> None:
    correction = gathered({"/a": 0.0, "/b": -0.2, "/c": -0.5}).correction()
    assert (
        correction.shifts.get("/a", 0),
        correction.shifts.get("/b", 0),
        correction.warnings,
    ) == (0, 0, ())
    assert seconds(correction.time(received("/a", 3.0, 2.75)) - BEGIN) == 2.75
    assert seconds(correction.time(received("/a", 3.0, None)) - BEGIN) == 3.0
    assert seconds(correction.time(received("/unknown", 3.0, None)) - BEGIN) == 3.0


def test_the_clock_that_departs_is_shifted() -> None:
    correction = gathered({"/a": 0.0, "/camera": 90.0, "/c": -0.1}).correction()
    assert abs(seconds(correction.shifts.get("/camera", 0)) + 90.0) < 0.02
    assert correction.shifts.get("/c", 0) == 0
    assert len(correction.warnings) == 1
    assert "the clock of /camera is 90 s ahead of" in correction.warnings[0]
    time = correction.time(received("/camera", 5.0, 95.0))
    assert abs(seconds(time - BEGIN) - 5.0) < 0.02


def test_of_two_clocks_the_one_by_the_log_is_believed() -> None:
    correction = gathered({"/a": -3600.0, "/b": 0.0}).correction()
    assert correction.shifts.get("/b", 0) == 0
    assert abs(seconds(correction.shifts.get("/a", 0)) - 3600.0) < 0.02


def test_a_robot_of_another_time_is_taken_as_it_is() -> None:
    correction = gathered({"/a": -5000.0, "/b": -5000.1, "/c": -5000.2}).correction()
    assert [correction.shifts.get(topic, 0) for topic in ("/a", "/b", "/c")] == [0, 0, 0]
    assert correction.warnings == ("stamps are 5e+03 s behind the log's clock, all alike",)
    assert abs(seconds(correction.time(received("/b", 7.0, None)) - BEGIN) + 4993.1) < 0.02


def test_a_stamp_far_off_its_topic_gives_way_to_the_logs_time() -> None:
    clocks = gathered({"/a": 0.0, "/b": 0.0})
    clocks.add(received("/a", 11, 5000.0))
    clocks.add(received("/a", 11, -5000.0))
    correction = clocks.correction()
    assert "2 messages on /a have stamps more than 10 s off" in correction.warnings[0]
    assert abs(seconds(correction.time(received("/a", 11, 5000.0)) - BEGIN) - 11.0) < 0.02


def test_a_stamp_far_off_its_topic_keeps_the_usual_offset_of_the_topic() -> None:
    clocks = gathered({"/late": -0.5, "/camera": 90.0, "/b": 0.0})
    clocks.add(received("/late", 11, 5000.0))
    clocks.add(received("/camera", 11, 5000.0))
    correction = clocks.correction()
    assert (correction.shifts.get("/late", 0), correction.shifts.get("/b", 0)) == (0, 0)
    # On /late every message is half a second old when it is logged; so is the one with the stamp.
    time = correction.time(received("/late", 11, 5000.0))
    assert abs(seconds(time - BEGIN) - 10.5) < 0.02
    regular = correction.time(received("/late", 11, 10.5))
    assert abs(seconds(time - regular)) < 0.02
    # The clock of /camera is shifted: its usual offset and its shift cancel, to the typical one.
    time = correction.time(received("/camera", 11, 5000.0))
    typical = seconds(correction.medians["/camera"] + correction.shifts.get("/camera", 0))
    assert abs(typical) < 0.02
    assert abs(seconds(time - BEGIN) - (11 + typical)) < 1e-6


def test_static_transforms_do_not_count() -> None:
    clocks = gathered({"/a": 0.0})
    content = TransformMessage("a", "b", np.eye(4), static=True)
    clocks.add(Received("/tf_static", BEGIN + 10 * SECOND, BEGIN - 9999 * SECOND, content))
    assert clocks.correction().warnings == ()


def test_steps_of_the_logs_time_are_counted() -> None:
    clocks = Clocks(ClockRig(jump=10.0))
    for time in (0, 1, 100, 2, 3, 4, 50, 5):
        clocks.add(received("/a", time, None))
    assert clocks.correction().warnings == (
        "the log's time steps ahead by more than 10 s, 2 times",
        "the log's time steps back by more than 10 s, 2 times",
    )


def test_the_logs_times_count_for_all_if_told_so() -> None:
    correction = gathered({"/a": 90.0, "/b": 0.0}, ClockRig(stamp="log")).correction()
    assert correction.shifts.get("/a", 0) == 0
    assert correction.time(received("/a", 3.0, 93.0)) == BEGIN + 3 * SECOND
