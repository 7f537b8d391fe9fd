"""`python -m runners.probe session=recorded from=K`: a recording taken up again after a step."""

import pytest

from replay.__main__ import main
from replay.mcap.reader import read_recording
from runners import probe
from tests.runners.in_process import run

SMALL = ("method=anchored", "method.size=small", "recording=mcap")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A kinematic session that registers from its third contact on."""
    logs = tmp_path_factory.mktemp("whole")
    words = ("object=spam_can", "session=kinematic", "session.start_contacts=3", f"logs={logs}")
    words += ("seed=7",)
    done = run(probe.main, *words, *SMALL)
    assert (done.returncode, done.stderr) == (0, "")
    (path,) = logs.glob("probe/*/recording.mcap")
    return path


def gone_on(whole, logs, *words):
    done = run(
        probe.main, "session=recorded", f"session.path={whole}", *words, *SMALL[2:], f"logs={logs}"
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    (path,) = logs.glob("probe/*/recording.mcap")
    assert main(["verify", str(path)]) == 0
    return read_recording(path)


def test_the_same_method_goes_on_to_the_bit(whole, tmp_path):
    before = read_recording(whole)
    middle = before.steps[len(before.steps) // 2]
    after = gone_on(whole, tmp_path, f"from={middle}", *SMALL[:2], "seed=7")
    assert after.steps == before.steps
    for step in before.steps:
        assert after.hypotheses(step).digest == before.hypotheses(step).digest
    assert after.start.source != ""
    assert after.start.config["from"] == middle
    assert "from" not in before.start.config


@pytest.mark.parametrize("words", [("method=icp", "seed=7"), SMALL[:2]])
def test_another_method_or_seed_begins_with_all_points_of_the_recording(whole, tmp_path, words):
    before = read_recording(whole)
    middle = before.steps[len(before.steps) // 2]
    after = gone_on(whole, tmp_path, f"from={middle}", *words)
    assert after.steps == tuple(step for step in before.steps if step > middle)
    last = after.steps[-1]
    assert after.problem(last).points.digest == before.problem(last).points.digest


def test_a_policy_chooses_among_the_probes_that_are_left(whole, tmp_path):
    before = read_recording(whole)
    words = ("policy=information", "policy.probes=9", "policy.stop.gain=0", "policy.stop.spread=0")
    after = gone_on(whole, tmp_path, "from=5", *words, *SMALL[:2])
    steps = [one.step for one in after.probes]
    assert steps == list(range(len(steps)))
    for old, new in zip(before.probes[:6], after.probes, strict=False):
        assert old.new_points.digest == new.new_points.digest
    decisions = after.decision_steps
    assert min(decisions) == 5
    chosen = [after.decision(step).decision.chosen for step in decisions]
    assert all(one > 5 or one == -1 for one in chosen)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("session=recorded", "session.path={whole}", "from=99"), "no step 99; accepted: from=0"),
        (
            ("object=spam_can", "session=kinematic", "from=3"),
            "accepted: session=recorded with it",
        ),
        (("session=recorded", "session.path={whole}", "from=x"), "from"),
    ],
)
def test_what_cannot_be_gone_on_with_is_one_line(whole, tmp_path, words, message):
    words = [word.format(whole=whole) for word in words]
    done = run(probe.main, *words, f"logs={tmp_path}")
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("probe/*/recording.mcap"))
