"""`replay verify`: equal bits, the smallest difference, files that cannot be used."""

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from chsel import events
from chsel.events import HypothesesFound, Measured, SessionStarted, Traced
from chsel.problem.pose_prior import PosePrior
from chsel.session.loop import Loop
from replay.__main__ import main
from replay.comparing.differences import is_close, ulps
from replay.comparing.verification import DIFFERS, EQUAL, NO_RESULT, verified_files, verify
from replay.mcap.reader import read_recording
from tests.replay.conftest import changed, nth
from tests.tools.small_recordings import pushing_session, registered_session, steered_session

REPOSITORY = Path(__file__).resolve().parents[2]
REPLAYS = REPOSITORY / "tests" / "replays"
DESCENT = REPLAYS / "cracker_box_gradient_descent.mcap"
CHSEL = REPLAYS / "points_mustard.mcap"
OF_SESSION = Loop.of_session


@pytest.fixture(scope="module")
def descent():
    return registered_session("gradient_descent")


def measured(events, step, *, change):
    """The events with other measured values of a step."""
    old = nth(events, Measured, number=step)
    return changed(events, old, values={name: change(name, x) for name, x in old.values.items()})


def verdicts(path):
    return list(verify(read_recording(path)))


def test_equal_bits_are_status_0(capsys):
    assert main(["verify", str(CHSEL)]) == 0
    shown = capsys.readouterr()
    pattern = rf"{CHSEL}: 4 of 4 steps equal \(\w+\), \d+\.\d s, digest \w{{32}}\n"
    assert re.fullmatch(pattern, shown.out)
    assert shown.err == ""


def test_one_cost_that_is_one_ulp_larger_is_found(descent, write, capsys):
    old = nth(descent, HypothesesFound, number=1)
    cost = old.hypotheses.cost.copy()
    cost[2] = np.nextafter(cost[2], 0.0)
    path = write(changed(descent, old, hypotheses=dataclasses.replace(old.hypotheses, cost=cost)))
    found = verdicts(path)
    assert [verdict.outcome for verdict in found] == [EQUAL, DIFFERS]
    assert (found[1].stage, found[1].largest_ulps) == ("choosing the hypotheses", 1)
    assert found[1].differences[0].startswith("cost: 1 of 4 numbers by up to 1 ulp")
    assert main(["verify", str(path)]) == 1
    shown = capsys.readouterr().out
    assert "1 of 2 steps equal" in shown
    assert "largest difference: 1 ulp\n" in shown
    assert "environment: " in shown
    for changes, told in (((), "the same as recorded"), (("numpy 1 for 2",), "numpy 1 for 2")):
        verdict = dataclasses.replace(verdicts(path)[0], outcome=DIFFERS, environment=changes)
        assert verdict.report().endswith(f"environment: {told}")


def test_another_last_result_shows_in_how_the_next_sets_follow(descent, write):
    """E_0 and E_l of the next problem were not made from it; of another recording they may be."""
    old = nth(descent, HypothesesFound)
    poses = old.hypotheses.object_from_world.copy()
    poses[0, 0, 3] += 0.01
    other = dataclasses.replace(old.hypotheses, object_from_world=poses)
    events = changed(descent, old, hypotheses=other)
    found = verdicts(write(events))
    assert [verdict.outcome for verdict in found] == [DIFFERS, DIFFERS]
    assert found[1].stage == "making E_0"
    found = verdicts(write(changed(events, events[0], source="0" * 32)))
    assert [verdict.outcome for verdict in found] == [DIFFERS, EQUAL]


def test_a_changed_trace_names_its_iteration(write):
    events = registered_session("chsel")
    traces = [e for e in events if isinstance(e, Traced) and e.stage == "cma_mega"]
    (found, after) = verdicts(write(changed(events, traces[1], digest="0" * 32)))
    assert found.stage == f"cma_mega, iteration {traces[1].iteration}"
    assert found.before > 2
    assert after.outcome == EQUAL


def test_wrong_numbers_are_named(descent, write, capsys):
    """Errors to the true pose, and how far a result is trusted, are computed again."""
    halved = ("best_position_error", "closest_position_error", "modes", "verdict")
    path = write(measured(descent, 1, change=lambda n, x: x / 2 + 0.1 if n in halved else x))
    found = verdicts(path)
    assert [verdict.outcome for verdict in found] == [EQUAL, DIFFERS]
    assert found[1].stage == "the measured values"
    names = {line.split(":")[0].removeprefix("values.") for line in found[1].differences}
    assert names == set(halved)
    assert main(["verify", str(path)]) == 1
    assert "step 1, gradient_descent: differs" in capsys.readouterr().out
    without = [e for e in descent if not isinstance(e, Measured) or e.step < 1]
    stages = [verdict.stage for verdict in verdicts(write(without))]
    assert stages == ["", "the measured values, which are not recorded"]


def test_numbers_may_differ_as_libraries_round_and_no_more(descent, write):
    for factor, outcome in ((1 + 1e-13, EQUAL), (1 + 1e-7, DIFFERS)):
        path = write(measured(descent, 0, change=lambda _, x, by=factor: x * by))
        assert next(verify(read_recording(path))).outcome == outcome
    assert is_close(0.01, 0.01 + 0.9e-4, name="best_position_error")
    assert not is_close(0.01, 0.01 + 1.1e-4, name="best_position_error")
    assert not is_close(0.01, 0.01 + 1e-6, name="archive_coverage")
    assert not is_close(0.01, None, name="best_position_error")


def test_a_registration_that_was_interrupted_has_nothing_to_compare(descent, write, capsys):
    first, last = (i for i, event in enumerate(descent) if isinstance(event, HypothesesFound))
    path = write(descent[:last])
    assert [verdict.outcome for verdict in verdicts(path)] == [EQUAL, NO_RESULT]
    assert main(["verify", str(path)]) == 0
    assert "1 of 1 steps equal (gradient_descent)" in capsys.readouterr().out
    path = write(descent[:first])
    assert main(["verify", str(path)]) == 2
    message = "has no registration with a result to verify; accepted: a recording of at least one"
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", f"error: recording {path} {message}\n")


def test_other_settings_than_those_that_gave_the_result_are_found(descent, write):
    config = nth(descent, SessionStarted).config
    config = {**config, "method": {**config["method"], "descent": {"restarts": 3}}}
    found = verdicts(write(changed(descent, descent[0], config=config)))
    assert {verdict.outcome for verdict in found} == {DIFFERS}
    assert "which does not come about" in found[0].stage


@pytest.fixture
def pushing(write):
    return write(pushing_session())


def outcomes(path):
    return [(verdict.step, verdict.outcome, verdict.stage) for verdict in verdicts(path)]


def test_pushes_and_the_first_registration_are_computed_and_equal(pushing):
    recording = read_recording(pushing)
    assert recording.start.start == events.Start(contacts=6)
    assert recording.start.moves == 0.02
    assert len(recording.problem(2).pushes.directions) == 3
    assert outcomes(pushing) == [(1, EQUAL, ""), (2, EQUAL, "")]


def test_other_pushes_by_the_same_touches_differ(pushing, monkeypatch):
    monkeypatch.setattr(events, "_LEAST_SIDEWAYS", 2.0)  # no touch pushes
    assert outcomes(pushing) == [(1, DIFFERS, "pushes"), (2, DIFFERS, "pushes")]


def test_a_prior_is_recorded_and_another_one_differs(write, monkeypatch):
    prior = PosePrior(
        centre=[0.1, 0.2, 0.3],
        centre_noise=0.02,
        axis=[1.0, 2.0, 3.0],
        along=[0.3, -0.2, 0.1],
        axis_noise=0.2,
        object_from_world=[np.eye(4), np.eye(4)],
        covariances=np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03]),
        weights=[0.3, 0.6],
    )
    path = write(pushing_session(prior=prior))
    recording = read_recording(path)
    assert recording.start.prior.digest == prior.digest
    assert recording.problem(2).prior.digest == prior.digest
    assert outcomes(path) == [(1, EQUAL, ""), (2, EQUAL, "")]
    for other in (None, dataclasses.replace(prior, centre_noise=0.03)):
        monkeypatch.setattr(Loop, "of_session", with_prior(other))
        assert outcomes(path) == [(1, DIFFERS, "prior"), (2, DIFFERS, "prior")]


def with_prior(prior):
    """Return `Loop.of_session` for sessions with another prior."""

    def other(started, *arguments, **named):
        started = dataclasses.replace(started, prior=prior)
        return OF_SESSION(started, *arguments, **named)

    return other


def test_a_prior_that_was_not_recorded_differs(pushing, monkeypatch):
    prior = PosePrior(axis=[0.0, 0.0, 1.0], along=[0.0, 0.0, 1.0], axis_noise=0.1)
    monkeypatch.setattr(Loop, "of_session", with_prior(prior))
    assert outcomes(pushing) == [(1, DIFFERS, "prior"), (2, DIFFERS, "prior")]


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        (1, [(0, DIFFERS, "a registration, which is not recorded"), (1, EQUAL), (2, EQUAL)]),
        (11, [(1, DIFFERS, "making E_0, which does not come about"), (2, EQUAL)]),
    ],
)
def test_another_first_registration_differs(contacts, expected, pushing, monkeypatch):
    def enough(loop):
        return len(loop.state.points.contacts) >= contacts

    monkeypatch.setattr(Loop, "enough", property(enough))
    found = outcomes(pushing)
    assert [(*one, "") if len(one) == 2 else one for one in expected] == found


def test_a_registration_that_was_not_to_be_is_explained(pushing, monkeypatch, capsys):
    monkeypatch.setattr(Loop, "enough", property(lambda loop: loop.state.step > 1))
    assert main(["verify", str(pushing)]) == 1
    assert "now it ends: this step does not register" in capsys.readouterr().out


def test_where_a_program_asks_for_registrations_their_steps_are_not_compared(write, monkeypatch):
    events_of = pushing_session()
    path = write(changed(events_of, events_of[0], start=None))
    monkeypatch.setattr(Loop, "enough", property(lambda loop: loop.state.step > 1))
    assert outcomes(path) == [(1, EQUAL, ""), (2, EQUAL, "")]


@pytest.mark.parametrize("limit", [0.0, 1e9])
def test_another_limit_of_surprises_differs(limit, write, monkeypatch):
    """The recorded limit is 1e9, and 0 makes a surprise of every touch; and the other way round."""
    path = write(steered_session(surprise={"limit": 1e9 - limit, "larger": 2}))
    assert {outcome for _, outcome, _ in outcomes(path)} == {EQUAL}
    surprised = property(lambda loop: loop.policy is not None and loop.state.surprise > limit)
    monkeypatch.setattr(Loop, "_is_surprised", surprised)
    assert (0, DIFFERS, "making E_0") in outcomes(path)


def test_several_files_and_processes_give_the_same_verdicts(tmp_path, capsys):
    folder = tmp_path / "several"
    folder.mkdir()
    for path in (DESCENT, CHSEL):
        shutil.copy(path, folder)
    (folder / "broken.mcap").write_bytes(DESCENT.read_bytes()[:5000])
    paths = sorted(folder.iterdir())
    alone = list(verified_files(paths))
    together = list(verified_files(paths, jobs=2))
    for file in (*alone, *together):
        file.seconds = 0.0
    assert alone == together
    assert main(["verify", str(folder)]) == 2
    shown = capsys.readouterr()
    assert "3 recordings: 8 of 8 steps equal" in shown.out
    assert shown.err.startswith(f"error: recording {folder}/broken.mcap is unfinished")
    assert shown.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([str(DESCENT), "--step", "3"], "has no registration problem of step 3; accepted: 8, 9"),
        ([str(DESCENT), "--jobs", "0"], "--jobs is 0; accepted: an integer from 1 to 256"),
        ([str(Path(__file__).parent)], "has no recordings; accepted: files *.mcap in it"),
    ],
)
def test_what_cannot_be_verified_is_one_line_and_status_2(arguments, message, capsys):
    assert main(["verify", *arguments]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("error: ")
    assert message in shown
    assert shown.count("\n") == 1


def test_ulps_count_the_numbers_between():
    left = np.array([1.0, 0.0, -0.0, 5e-324, -1.0, 1.5])
    right = np.array([1.0 + 2.0**-51, -0.0, 5e-324, -5e-324, -1.0 - 2.0**-52, 1.5])
    assert ulps(left, right).tolist() == [2, 1, 2, 3, 1, 0]
