"""`diff`: the first difference between two recordings, and all of them."""

import dataclasses
import math
import re

import numpy as np

from chsel.events import HypothesesFound, Measured, Traced
from replay.__main__ import main
from replay.verbs.diff import FIRST, SECOND, recording_diff
from tests.replay.conftest import changed, nth


def texts(first, second, *ignored):
    return [str(item) for item in recording_diff(first, second, ignored=ignored).differences]


def test_a_bit_of_one_cost_is_found(events, write, capsys):
    found = nth(events, HypothesesFound, number=1)
    cost = found.hypotheses.cost.copy()
    cost[0] = np.nextafter(np.nextafter(cost[0], 9.0), 9.0)
    other = dataclasses.replace(found.hypotheses, cost=cost)
    first = write(events)
    second = write(changed(events, found, hypotheses=other))
    assert main(["diff", str(first), str(second)]) == 1
    lines = capsys.readouterr().out.split("\n")
    assert re.fullmatch(
        r"first difference: /hypotheses, step 2: cost: 1 of 5 numbers by up to 2 ulp \(\S+\), "
        "the first at 0",
        lines[0],
    )
    rows = [re.split(r"\s{2,}", line.strip()) for line in lines]
    assert ["/hypotheses", "2", "cost", "1", "2", "0", "0", "2"] in rows
    assert main(["diff", str(first), str(write(events))]) == 0
    assert capsys.readouterr().out == "equal to the byte\n"


def test_settings_and_environment_differ_by_key(events, write, capsys):
    config = {"object": {"name": "电钻", "scale": 2.5}, "flags": [True, None, -1.0], "new": {}}
    environment = {"torch": "2.14.0", "numpy": "2.4.6", "libigl": "2.6"}
    other = dataclasses.replace(events[0], config=config, environment=environment)
    first = write(events)
    second = write([other, *events[1:]])
    assert texts(first, second) == [
        "/session, start: config.object.scale: 1.5 -> 2.5",
        "/session, start: config.flags[2]: -1 -> -1.0",
        "/session, start: config.flags[3]: 1e-300 -> absent",
        "/session, start: environment.torch: 2.13.0 -> 2.14.0",
        "/session, start: environment.platform: Linux -> absent",
        "/session, start: config.new: absent -> {}",
        "/session, start: environment.libigl: absent -> 2.6",
    ]
    assert texts(first, second, "environment", "config.flags", "config.new") == [
        "/session, start: config.object.scale: 1.5 -> 2.5"
    ]
    assert main(["diff", str(first), str(second), "--ignore", "environment", "config"]) == 0
    expected = "equal in content, leaving out environment, config; the files differ in other bytes"
    assert capsys.readouterr().out == f"{expected}\n"


def test_an_event_too_many_shifts_nothing(events, write):
    place = events.index(nth(events, Traced))
    more = [
        *events[:place],
        Traced(
            1,
            "descent",
            iteration=50,
            digest="1" * 32,
            lowest_cost=0.0,
            median_cost=1.0,
            highest_cost=2.0,
        ),
        *events[place:],
    ]
    first, second = write(events), write(more)
    for pair, having in (((first, second), SECOND), ((second, first), FIRST)):
        expected = f"/trace, step 1, descent iteration 50: only in the {having} recording"
        assert texts(*pair) == [expected]


def test_signed_zeros_differ_and_equal_nan_do_not(events, write):
    def with_values(*values):
        numbers = {f"number_{index}": value for index, value in enumerate(values)}
        return write(changed(events, nth(events, Measured), values=numbers))

    first = with_values(0.0, math.nan, 1.0, math.inf)
    found = texts(first, with_values(-0.0, math.nan, 1.0 + 2.0**-52, -math.inf))
    assert found[:2] == [
        "/measured, step 1: values.number_0: 0.0 -> -0.0 (1 ulp)",
        "/measured, step 1: values.number_2: 1.0 -> 1.0000000000000002 (1 ulp)",
    ]
    assert found[2].startswith("/measured, step 1: values.number_3: inf -> -inf (")
    assert len(found) == 3
