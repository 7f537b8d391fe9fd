"""docs/writing_a_policy.md: what stands there is what a user does, and it replays."""

import numpy as np
import pytest

from chsel.next_probe.forecast import Forecast
from chsel.policies import build_policy
from replay.events import Decided
from replay.mcap.reader import read_recording
from tests.docs.page import commands, shell, write_files

pytestmark = pytest.mark.slow
PAGE = "writing_a_policy.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder in which everything on the page was done."""
    folder = tmp_path_factory.mktemp("policy")
    write_files(PAGE, folder)
    for command in commands(PAGE):
        done = shell(command, folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return folder


def test_the_first_probe_is_by_entropy_and_those_after_by_information(folder):
    (path,) = folder.glob("logs/probe/*/recording.mcap")
    read = read_recording(path)
    assert read.start.config["policy"]["name"] == "entropy_first"
    assert read.start.config["policy"]["first"] == 1
    decisions = [event for event in read.events() if isinstance(event, Decided)]
    assert [event.step for event in decisions] == [-1, 0, 1, 2]
    for name, event in zip(
        ("voxel_entropy", "information", "information"), decisions, strict=False
    ):
        expected = build_policy(name).rate(event.problem, Forecast(event.problem, 0.002))
        taken = np.isfinite(event.decision.score)
        assert taken.sum() > 50
        assert np.array_equal(event.decision.score[taken], expected[taken])


def test_without_the_package_a_decision_is_not_made_again(folder):
    (path,) = folder.glob("logs/probe/*/recording.mcap")
    done = shell(f"python -m replay verify {path}", folder, PYTHONPATH="")
    assert done.returncode == 2, done.stdout
    assert "policy is 'entropy_first'; accepted: grid," in done.stderr
