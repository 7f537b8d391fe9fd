"""Steered runs of `runners.probe`: decisions, stops, grasps and surprises."""

import json
import re

import numpy as np
import pytest
from scipy.stats import norm

from chsel.errors import SettingError
from chsel.events import Believed, Decided, Measured, Probe
from chsel.problem.registration_problem import VERDICTS
from chsel.session.loop import Loop
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from runners import probe
from runners.run.grasps import GraspConfig
from tests.runners.in_process import run

SESSION = ("object=spam_can", "session=kinematic", "method=anchored", "method.size=small")
SESSION += ("recording=mcap",)


def steered(logs, *overrides):
    done = run(probe.main, *SESSION, *overrides, f"logs={logs}", columns=120)
    assert done.returncode == 0, done.stderr
    (folder,) = (logs / "probe").iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    return done, read_recording(folder / "recording.mcap"), summary


def decided(recording):
    return [event for event in recording.events() if isinstance(event, Decided)]


@pytest.fixture(scope="module")
def informed(tmp_path_factory):
    return steered(tmp_path_factory.mktemp("logs"), "policy=information", "policy.probes=3")


def test_every_probe_follows_a_decision_and_the_last_decision_says_why_it_ends(informed):
    done, recording, summary = informed
    decisions = decided(recording)
    assert [event.step for event in decisions] == [-1, 0, 1, 2]
    assert [event.decision.stop for event in decisions] == ["", "", "", "budget"]
    shown = " ".join(done.stdout.split())
    assert "stopped after 3 probes: policy.probes allows no more; the pose is not " in shown
    probes = [event for event in recording.events() if isinstance(event, Probe)]
    actions = decisions[0].problem.actions
    for before, made in zip(decisions, probes, strict=False):
        chosen = before.decision.chosen
        assert before.problem.available[chosen]
        start = actions.world_from_hand[chosen]
        np.testing.assert_allclose(made.gripper_path[0], start, atol=1e-9)
        assert not decisions[made.step + 1].problem.available[chosen]
    row = summary["steps"][1]
    assert row["action"] == decisions[1].decision.chosen
    assert row["spread"] == decisions[2].decision.spread
    assert recording.start.config["policy"]["name"] == "information"


def test_registration_begins_with_the_first_contact(informed):
    probes = [event for event in informed[1].events() if isinstance(event, Probe)]
    touched = [made.step for made in probes if len(made.contacts)]
    assert informed[1].steps == tuple(range(touched[0], 3))


def test_a_session_stops_by_the_spread_at_the_first_result_that_is_determined(tmp_path):
    done, recording, summary = steered(tmp_path, "policy=information", "policy.stop.spread=0.1")
    *before, last = decided(recording)
    assert (last.decision.stop, last.problem.verdict) == ("spread", "determined")
    assert last.decision.spread <= 0.1
    assert "determined" not in {event.problem.verdict for event in before}
    assert any(event.decision.spread <= 0.1 for event in before)  # not yet determined
    measured = {event.step: event for event in recording.events() if isinstance(event, Measured)}
    for event in [*before, last]:
        verdict = event.problem.verdict
        if event.step in measured:
            assert measured[event.step].values["verdict"] == VERDICTS.index(verdict)
        else:
            assert verdict == ""
    shown = " ".join(done.stdout.split())
    assert "policy.stop.spread" in shown
    assert "is not determined" not in shown
    trust = summary["trust"]
    assert f"spread {1000.0 * trust['spread']:.1f} of {1000.0 * trust['limit']:.1f} mm" in shown
    assert re.search(r"\), centre within \d+\.\d mm, \d+°$", shown)


def test_a_session_ends_with_a_sure_grasp_and_says_how_sure_it_is_of_each_mode(tmp_path):
    """A can of 26 cm by 15 cm, held across by very wide fingers, is within them in any pose."""
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    file = tmp_path / "grasps.npz"
    np.savez(file, object_from_gripper=down[None], width=1.9)
    wide = ("grasp.gripper.opening=2", "grasp.gripper.length=0.1")
    grasp = (f"grasp.path={file}", "grasp.sure=0.97", *wide)
    done, recording, summary = steered(tmp_path, "policy=information", *grasp)
    assert "stopped: a grasp works with a chance of" in done.stdout
    last = summary["steps"][-1]
    assert last["stop"] == "grasp"
    assert last["grasp_chance"] == 1.0
    # Wilson's interval of n successes in n trials is from n / (n + z^2) to 1.
    lower, upper = last["grasp_chance_interval"]
    trials = lower / (1.0 - lower) * norm.ppf(0.95) ** 2
    assert (trials, upper) == pytest.approx((round(trials), 1.0))
    assert 1 < trials < 31
    assert last["action"] == decided(recording)[-1].decision.chosen
    assert all(row.get("grasp_chance", 0.0) < 0.97 for row in summary["steps"][:-1])
    believed = [event for event in recording.events() if isinstance(event, Believed)]
    assert [event.step for event in believed] == list(recording.steps)
    for row, event in zip(summary["steps"][-len(believed) :], believed, strict=True):
        assert [mode["weight"] for mode in row["belief"]] == event.weights.tolist()
    assert {verdict.outcome for verdict in verify(recording)} == {EQUAL}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "not a readable .npz file (File is not a zip file)"),
        ({"object_from_gripper": np.eye(4)[None]}, "its arrays are object_from_gripper"),
        ({"object_from_gripper": np.eye(4), "width": 0.1}, "object_from_gripper has shape (4, 4)"),
        ({"object_from_gripper": np.ones((1, 4, 4)), "width": 0.1}, "object_from_gripper[0] is no"),
        ({"object_from_gripper": np.eye(4)[None], "width": [0.1, 0.1]}, "broadcast"),
        ({"object_from_gripper": np.eye(4)[None], "width": 0.0}, "a width that is not above 0"),
        ({"object_from_gripper": np.zeros((0, 4, 4)), "width": 0.1}, "it has no grasp"),
    ],
)
def test_a_mistake_in_a_file_of_grasps_is_one_line(arrays, message, tmp_path):
    file = tmp_path / "grasps.npz"
    if arrays is None:
        file.write_bytes(b"half")
    else:
        np.savez(file, **arrays)
    with pytest.raises(SettingError) as caught:
        GraspConfig(path=str(file)).grasps()
    text = str(caught.value)
    assert text.startswith(f"grasp.path is {file} (")
    assert text.endswith("with object_from_gripper (G, 4, 4) and width (G,), metres")
    assert message in text


def test_a_surprise_starts_the_next_registration_afresh(tmp_path, monkeypatch):
    surprised = Loop._is_surprised.fget

    def or_at_the_third(loop):
        return surprised(loop) or loop.state.step == 2

    monkeypatch.setattr(Loop, "_is_surprised", property(or_at_the_third))
    _, recording, _ = steered(tmp_path, "policy=information", "policy.probes=4")
    sizes = [len(recording.problem(step).initial_set) for step in recording.steps]
    assert dict(zip(recording.steps, sizes, strict=True))[2] == 90
    assert len(recording.problem(2).low_cost_set) == 0
    assert len(recording.problem(3).initial_set) == 30


def test_the_grid_is_not_recorded_as_a_policy(tmp_path):
    _, recording, _ = steered(tmp_path, "policy=grid", "session.start_contacts=99")
    assert decided(recording) == []
    assert "policy" not in recording.start.config


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("policy=informative",), "informative"),
        (("policy=information", "policy.noise=0"), "noise is 0"),
        (("policy=information", "policy.action.spacing=1"), "action"),
        (("policy=information", "policy.actions.choice=sideways"), "accepted: configuration"),
    ],
)
def test_a_mistake_is_one_line(overrides, message, tmp_path):
    done = run(probe.main, *SESSION, *overrides, f"logs={tmp_path}")
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.strip().count("\n") == 0


def test_given_points_cannot_be_steered(tmp_path):
    np.savez(tmp_path / "points.npz", surface=0.04 * np.eye(3))
    place = f"session.path={tmp_path / 'points.npz'}"
    done = run(probe.main, "session=points", place, "policy=information", f"logs={tmp_path}")
    assert done.returncode == 2
    assert "session points cannot be steered" in done.stderr
