"""Clocks of logs, and the windows of probes between them."""

import numpy as np
import pytest

from runners.sensors.log.clocks import SLACK, Clocks, in_time_order
from runners.sensors.log.messages import Received, TransformMessage
from runners.sensors.log.probe_windows import marked_windows
from runners.sensors.rig import ClockRig
from runners.sensors.session_report import LogWarnings

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND


def received(topic, time, *, stamp):
    """A message at seconds since BEGIN."""
    sent = None if stamp is None else BEGIN + round(stamp * SECOND)
    return Received(topic, BEGIN + round(time * SECOND), stamp=sent, content="x")


def gathered(offsets, rig=None):
    """Eleven messages a topic, whose stamps are off by so many seconds and some milliseconds."""
    clocks = Clocks(rig or ClockRig())
    random = np.random.default_rng(0)
    static = TransformMessage(
        "a", "b", parent_from_child=np.eye(4), static=True
    )  # of long ago, as it may be
    clocks.add(
        Received("/tf_static", BEGIN + 10 * SECOND, stamp=BEGIN - 9999 * SECOND, content=static)
    )
    for time in range(11):
        for topic, offset in offsets.items():
            clocks.add(received(topic, time, stamp=time + offset - 0.01 * random.random()))
    return clocks


@pytest.mark.parametrize(
    ("offsets", "shifts", "said"),
    [
        ({"/a": 0.0, "/b": -0.2, "/c": -0.5}, {}, ""),
        (
            {"/a": 0.0, "/camera": 90.0, "/c": -0.1},
            {"/camera": -90.0},
            "the clock of /camera is 90 s ahead of other topics': its stamps are shifted",
        ),
        # Of two clocks, the one nearer to the log's is believed.
        (
            {"/a": -3600.0, "/b": 0.0},
            {"/a": 3600.0},
            "the clock of /a is 3.6e+03 s behind other topics': its stamps are shifted",
        ),
        (
            {"/a": -5000.0, "/b": -5000.1, "/c": -5000.2},
            {},
            "stamps are 5e+03 s behind the log's clock, all alike",
        ),
    ],
)
def test_clocks_that_depart_are_shifted(offsets, shifts, said):
    correction = gathered(offsets).correction()
    assert correction.shifts.keys() == shifts.keys()
    for topic, shift in shifts.items():
        assert correction.shifts[topic] / SECOND == pytest.approx(shift, abs=0.02)
    assert "".join(correction.warnings) == said
    typical = sorted(offsets.values())[1]
    for topic, offset in offsets.items():
        stamped = correction.time(received(topic, 5.0, stamp=5.0 + offset)) - BEGIN
        shifted = typical if topic in shifts else offset
        assert stamped / SECOND == pytest.approx(5.0 + shifted, abs=0.02)
    unstamped = correction.time(received("/unknown", 7.0, stamp=None)) - BEGIN
    assert unstamped / SECOND == pytest.approx(7.0 + typical * (abs(typical) > 1.0), abs=0.02)


@pytest.mark.parametrize(
    ("offsets", "step"),
    [
        ([0.0] * 6 + [0.6] * 6, "+0.6"),
        ([0.0] * 6 + [-0.2] * 6, "-0.2"),
        ([0.0] * 6 + [0.05] * 6, None),  # a moving hand is off by millimetres
        ([0.0] * 6 + [-0.6] * 2 + [0.0] * 6, None),  # two come late
        ([0.0, -0.6] * 8, None),  # of two senders
        ([0.0] * 4 + [-0.6] * 3, None),  # too few to tell
    ],
)
def test_a_lasting_step_of_a_clock_below_the_limit_is_said(offsets, step):
    clocks = Clocks(ClockRig())
    for number, offset in enumerate(offsets):
        clocks.add(received("/camera", number, stamp=number + offset))
    correction = clocks.correction()
    said = [] if step is None else [f"stamps on /camera jump by {step} s against the log's clock"]
    assert [text.split(", which")[0] for text in correction.warnings] == said
    assert correction.time(received("/camera", 11.0, stamp=11.6)) == BEGIN + round(11.6 * SECOND)


def test_the_logs_times_count_for_all_if_told_so():
    correction = gathered({"/a": 90.0, "/b": 0.0}, ClockRig(stamp="log")).correction()
    assert correction.time(received("/a", 3.0, stamp=93.0)) == BEGIN + 3 * SECOND


def test_messages_come_in_the_order_of_their_times_if_they_are_not_too_late():
    stamps = [3, 1, 2, 9, 5, 4, 30, 0]  # the last one comes long after its place
    logged = [0, 0, 0, 1, 1, 1, 3 * SLACK, 3 * SLACK]
    messages = [
        Received("/t", times[0], stamp=times[1], content="")
        for times in zip(logged, stamps, strict=True)
    ]
    got = [time for time, _ in in_time_order(messages, lambda message: message.stamp or 0)]
    assert got == [1, 2, 3, 4, 5, 9, 0, 30]


def spans(*texts):
    """Windows of markers at times 10, 20, ... in a log from 0 to 100, and the warnings."""
    warnings = LogWarnings()
    markers = [(10 * (index + 1), text) for index, text in enumerate(texts)]
    windows = marked_windows(reversed(markers), 0, last=100, warnings=warnings)
    found = [(w.step, w.opens, w.begin, w.end, w.closes) for w in windows]
    return found, [text for _, text in warnings.lines()]


def test_a_window_reaches_to_the_next_begin_and_the_first_one_to_the_start():
    found, said = spans("begin 0", "end 0", " Begin 1", "END 1")
    assert found == [(0, 0, 10, 20, 30), (1, 30, 30, 40, 101)]
    assert said == []


@pytest.mark.parametrize(
    ("texts", "steps"),
    [
        (("4", "4", "4", "-1", "-1", "7", "7", "-1"), [4, 7]),
        (("False", "True", "True", "False", "False", "True", "True", "False"), [0, 1]),
        (("0", "0", "1", "-5"), [0, 1]),  # a change of number ends a probe
    ],
)
def test_states_that_are_sent_all_the_time_say_nothing_new(texts, steps):
    found, said = spans(*texts)
    assert ([step for step, *_ in found], said) == (steps, [])
    if steps[1] == 1 and texts[0] == "0":
        assert found == [(0, 0, 10, 30, 30), (1, 30, 30, 40, 101)]
