"""Values and orders of events that writer and reader refuse, each with one clear line."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from chsel.errors import RecordingError
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SnapshotTaken,
    Timed,
)
from chsel.problem.points import KnownPoints
from replay.mcap.reader import read_recording
from tests.replay.conftest import changed, example_events, nth, with_sensors

Events = list[Event]
Change = Callable[[Events], Events]


def first(kind, /, **values):
    """Other values of the first event of a kind."""
    return lambda events: changed(events, nth(events, kind), **values)


def result(make):
    """Other values of the first result, made of the old ones."""

    def change(events):
        old = nth(events, HypothesesFound).hypotheses
        return first(HypothesesFound, hypotheses=dataclasses.replace(old, **make(old)))(events)

    return change


def archive(**values):
    """Other values of the archive of the first result."""
    return result(lambda found: {"archive": dataclasses.replace(found.archive, **values)})


def inserted(place, event):
    return lambda events: [*events[:place], event, *events[place:]]


def before(kind, event):
    return lambda events: inserted(events.index(nth(events, kind)), event)(events)


def repeated(kind):
    return lambda events: before(kind, nth(events, kind))(events)


def moved(kind, behind):
    def change(events):
        event = nth(events, kind)
        return before(behind, event)([other for other in events if other is not event])

    return change


def without(kind):
    return lambda events: [event for event in events if not isinstance(event, kind)]


WRONG: dict[str, Change] = {
    # results
    r"Hypotheses of step 1: cost is out of order": result(lambda e: {"cost": e.cost[::-1].copy()}),
    "cost is -inf": result(lambda e: {"cost": np.array([-np.inf, 1, 2, 3, 4.0])}),
    r"object_from_world\[0\] is not a rigid": result(
        lambda e: {"object_from_world": 1.5 * e.object_from_world}
    ),
    "object_from_world is not finite where": result(
        lambda e: {"object_from_world": np.nan * e.object_from_world}
    ),
    r"elites\[0\] is not a rigid": result(lambda e: {"elites": 0.0 * e.elites}),
    "cell is out of range; accepted: -1 to 1599": result(
        lambda e: {"cell": np.full(5, 1600, dtype=np.int64)}
    ),
    "cell is out of range; accepted: -1 to -1": result(lambda e: {"archive": None}),
    "has cells out of order": archive(cells=np.zeros(12, dtype=np.int64)),
    "has 2 axes, but names": archive(measure_names=("x",), refinement=2),
    "objectives has a number that is not finite": archive(objectives=np.full(12, np.nan)),
    # numbers and texts
    "seconds has a number that": inserted(5, Timed(0, {"a": np.inf})),
    r"a name of values holds the character '\\x1b'": inserted(5, Measured(0, {"\x1b": 1.0})),
    "a log line holds the character": inserted(5, Logged(0, "info", text="\x00")),
    # sensors
    r"SensorImage of step 0: sensor is 'a/b'; accepted: letters, digits and _": first(
        SensorImage, sensor="a/b"
    ),
    "kind is 'color'; accepted: depth, deformation": first(SensorImage, kind="color"),
    r"unit is nan; accepted: 1e-09 to 1000 \(m\)": first(SensorImage, unit=np.nan),
    "intrinsics .* above 0": first(SensorImage, intrinsics=np.array([0.0, 1.0, 2.0, 3.0])),
    "no triangle of its vertices": first(
        RigDescribed, hand=trimesh.Trimesh(np.eye(3), [[0, 1, 3]], process=False)
    ),
    # order
    "probe 0 follows probe 0": inserted(8, Probe(0, "free", new_points=KnownPoints())),
    "step 1 has a second registration problem": repeated(ProblemPosed),
    "/hypotheses of step 1 is in no registration of it": repeated(HypothesesFound),
    "/archive of step 1 is in no registration": moved(HypothesesFound, SnapshotTaken),
    "an event follows the end of the session": repeated(SessionEnded),
    "step 0 follows one of step 1": before(ProblemPosed, Logged(0, "info", text="")),
    "there is a rig of step -1; accepted: one, before all steps": repeated(RigDescribed),
    "an image of step 0 does not precede the probe of its": moved(SensorImage, SessionEnded),
}


@pytest.fixture
def robot():
    """A session of two probes, with sensors and a registration."""
    return with_sensors(example_events(steps=2, free=3))


@pytest.mark.parametrize("message", WRONG)
def test_it_is_refused_by_writer_and_reader(robot, write, monkeypatch, message):
    events = WRONG[message](robot)
    if "does not precede the probe" in message:
        events = without(SessionEnded)([e for e in events if e.step < 1])
    with pytest.raises(RecordingError, match=message):
        write(events)
    with monkeypatch.context() as careless:
        careless.setattr("replay.mcap.writer.check_message", lambda name, values: None)
        careless.setattr("replay.mcap.foxglove_messages.check_text", lambda what, text: None)
        careless.setattr("replay.mcap.writer.EventOrder.take", lambda order, topic, step: None)
        path = write(events)
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


def test_a_diverged_start_of_infinite_cost_is_a_result(robot, write, assert_same):
    def diverged(found):
        cost, poses = found.cost.copy(), found.object_from_world.copy()
        cost[-1], poses[-1, :3] = np.inf, np.nan
        return {"cost": cost, "object_from_world": poses}

    events = result(diverged)(robot)
    assert_same(read_recording(write(events)).events(), events)


def test_rig_and_images_are_found_by_step(sensor_events, write, assert_same):
    recording = read_recording(write(sensor_events))
    assert (recording.rig.name, recording.rig.source) == ("cabinet", "sha256:0a1b")
    assert recording.image_steps == (0, 1, 2)
    written = [event for event in sensor_events if isinstance(event, SensorImage)]
    assert_same(recording.sensor_images([1]), [event for event in written if event.step == 1])
    assert_same(recording.sensor_images(), written)
    assert not any(isinstance(event, SensorImage) for event in recording.events(images=False))
    with pytest.raises(RecordingError, match="no image of a sensor of step 7; accepted: 0, 1, 2"):
        recording.sensor_images([7])


def test_a_recording_gives_actions_and_decisions_back(steered_events, write, assert_same):
    recording = read_recording(write(steered_events))
    assert recording.decision_steps == (-1, 0, 1, 2)
    written = [event for event in steered_events if isinstance(event, Decided | ActionsOffered)]
    read = [recording.offered, *map(recording.decision, recording.decision_steps)]
    assert_same(read, written)
    with pytest.raises(RecordingError, match=r"no decision of step 3; accepted: -1, 0, 1, 2$"):
        recording.decision(3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"chosen": 4}, "chosen is 4; accepted: -1 to 3"),
        ({"chosen": 0}, "action 0 is chosen, which cannot be taken"),
        ({"stop": "gain"}, "action 1 is chosen with the stop 'gain'"),
        ({"chosen": -1}, "action -1 is chosen with the stop ''"),
        ({"score": np.array([0.0, np.nan, 0.0, 0.0])}, "score has NaN or inf"),
        ({"hit_chance": np.array([0.0, 1.1, 0.0, 0.0])}, "hit_chance has a number that is no"),
        ({"expected_spread": np.full(4, np.inf)}, "expected_spread has a number that is not"),
        ({"contacts": np.zeros((2, 3))}, "2 contacts for 3 poses; accepted: one for each, or none"),
        ({"contacts": np.full((3, 3), np.inf)}, "a contact is not finite"),
    ],
)
def test_a_decision_that_makes_no_sense_is_not_written(steered_events, write, values, message):
    old = nth(steered_events, Decided, number=1)
    other = dataclasses.replace(old.decision, **values)
    with pytest.raises(RecordingError, match=message):
        write(changed(steered_events, old, decision=other))


def test_a_decision_is_of_the_actions_and_points_before_it(steered_events, write):
    one, other = (nth(steered_events, Decided, number=number) for number in (0, 1))
    for change, message in (
        (without(ActionsOffered), "a decision of step -1 has no actions before it"),
        (
            lambda events: changed(events, other, problem=one.problem),
            "points, a grid, a workspace, actions or a hand that",
        ),
    ):
        with pytest.raises(RecordingError, match=message):
            write(change(steered_events))
