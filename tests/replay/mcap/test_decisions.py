"""Decisions in recordings: what is written is read, and nothing else is accepted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chsel.errors import ChselError, RecordingError, SettingError
from chsel.next_probe.decision_problem import HandShape
from replay.events import ActionsOffered, Decided, Event, Measured, Probe, ProblemPosed
from replay.mcap.reader import read_recording

Write = Callable[[list[Event]], Path]


def changed(events: list[Event], **values: Any) -> list[Event]:
    """With other values in the decision after step 0."""
    return [
        dataclasses.replace(event, decision=dataclasses.replace(event.decision, **values))
        if isinstance(event, Decided) and event.step == 0
        else event
        for event in events
    ]


def test_a_recording_gives_actions_and_decisions_back(
    steered_events: list[Event], write: Write, assert_same: Callable[[Any, Any], None]
) -> None:
    recording = read_recording(write(steered_events))
    assert recording.decision_steps == (-1, 0, 1, 2)
    written = [event for event in steered_events if isinstance(event, Decided | ActionsOffered)]
    read = [recording.offered, *map(recording.decision, recording.decision_steps)]
    assert_same(read, written)
    assert_same(read[1:], [e for e in recording.events() if isinstance(e, Decided)])
    with pytest.raises(RecordingError, match=r"no decision of step 3; accepted: -1, 0, 1, 2$"):
        recording.decision(3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"chosen": 4}, "chosen is 4; accepted: -1 to 3"),
        ({"chosen": -2}, "chosen is -2"),
        ({"chosen": 0}, "action 0 is chosen, which cannot be taken"),
        ({"stop": "bored"}, "bored"),
        ({"stop": "gain"}, "action 1 is chosen with the stop 'gain'"),
        ({"chosen": -1}, "action -1 is chosen with the stop ''"),
        ({"score": np.array([0.0, np.nan, 0.0, 0.0])}, "score has NaN or inf"),
        ({"score": np.array([0.0, np.inf, 0.0, 0.0])}, "score has NaN or inf"),
        ({"score": np.zeros(3)}, r"it is float64 \(3,\)|shape"),
        ({"hit_chance": np.array([0.0, 1.1, 0.0, 0.0])}, "hit_chance has a number that is no"),
        ({"blocked_chance": np.full(4, np.nan)}, "blocked_chance has a number that is no"),
        ({"expected_spread": np.full(4, np.inf)}, "expected_spread has a number that is not"),
        ({"spread": float("nan")}, "spread is nan"),
        ({"contacts": np.zeros((2, 3))}, "2 contacts for 3 poses; accepted: one for each, or none"),
        ({"contacts": np.full((3, 3), np.inf)}, "a contact is not finite"),
    ],
)
def test_a_decision_that_makes_no_sense_is_not_written(
    steered_events: list[Event], write: Write, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(ChselError, match=message):
        write(changed(steered_events, **values))


def test_a_decision_stands_after_the_results_of_its_step(
    steered_events: list[Event], write: Write
) -> None:
    def moved(kind: type[Event], step: int) -> list[Event]:
        """With the decision after step 1 ahead of an event."""
        (one,) = (e for e in steered_events if isinstance(e, Decided) and e.step == 1)
        rest = [event for event in steered_events if event is not one]
        place = next(i for i, e in enumerate(rest) if isinstance(e, kind) and e.step == step)
        return [*rest[:place], one, *rest[place:]]

    write(moved(Measured, 1))
    for kind, step, message in (
        (Probe, 1, "a decision of step 1 follows probe 0"),
        (ProblemPosed, 1, "the registration of step 1 follows its decision"),
        (Probe, 2, None),
        (Decided, 2, "a decision of step 1 follows probe 2|follows one of step 2"),
    ):
        if message is None:
            write(moved(kind, step))
            continue
        with pytest.raises(RecordingError, match=message):
            write(moved(kind, step))


def test_actions_are_offered_once_at_the_start_of_a_steered_session(
    steered_events: list[Event], write: Write
) -> None:
    (offered,) = (event for event in steered_events if isinstance(event, ActionsOffered))
    rest = [event for event in steered_events if event is not offered]
    for events, message in (
        (rest, "a decision of step -1 has no actions before it"),
        ([rest[0], offered, offered], "accepted: once, before all steps"),
        ([rest[0], dataclasses.replace(offered, step=0)], "accepted: once, before all steps"),
    ):
        with pytest.raises(RecordingError, match=message):
            write(events)


def test_a_hand_far_from_its_origin_makes_no_problem(steered_events: list[Event]) -> None:
    """Its front, in cells of millimetres, would have none."""
    problem = next(event.problem for event in steered_events if isinstance(event, Decided))
    for offset in (2e6, 1e17, 1e300):
        hand = HandShape(problem.hand.vertices + offset, problem.hand.faces)
        with pytest.raises(SettingError, match=r"the hand reaches .* m from its origin; accepted"):
            dataclasses.replace(problem, hand=hand)


def test_the_problem_of_a_decision_follows_from_what_came_before(
    steered_events: list[Event], write: Write
) -> None:
    (first, second, *_) = (event for event in steered_events if isinstance(event, Decided))
    stale = dataclasses.replace(second, problem=first.problem)
    events = [stale if event is second else event for event in steered_events]
    with pytest.raises(RecordingError, match="points, a grid, a workspace, actions or a hand that"):
        write(events)
