"""Which time belongs to which probe."""

import pytest

from runners.sensors.log.probe_windows import marked_windows
from runners.sensors.session_report import LogWarnings


def spans(*texts):
    """Windows of markers at times 10, 20, ... in a log from 0 to 100, and the warnings."""
    warnings = LogWarnings()
    markers = [(10 * (index + 1), text) for index, text in enumerate(texts)]
    windows = marked_windows(reversed(markers), 0, 100, warnings)
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


def test_marks_that_do_not_fit_are_reported():
    found, said = spans("end 9", "begin 2", "hello", "begin 2", "begin 1")
    assert found == [(0, 0, 20, 50, 50), (1, 50, 50, 100, 101)]
    assert said == [
        "the marker 'end 9' does not follow a begin",
        "a marker is 'hello'; accepted: begin N, end",
        "the marker 'begin 1' does not follow an end",
        "the last probe has a begin and no end; the log's end ends it",
        "probes are marked 2, 1; as these do not rise, they are counted from 0 to 1",
    ]
    assert [step for step, *_ in spans("begin", "begin", "end")[0]] == [0, 1]
