"""Stored replays as items of pytest."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numba
import numpy as np
import pytest

from chsel.problem.settings import settings_mapping
from replay.events import HypothesesFound
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import measured_again

pytest_plugins = ["pytester"]
REPLAYS = Path(__file__).resolve().parents[1] / "replays"
DESCENT = REPLAYS / "cracker_box_gradient_descent.mcap"


@pytest.fixture(autouse=True, scope="module")
def _numba_as_a_whole():
    """Modules that are first imported within a test of pytester are forgotten after it.

    What numba imports when it first compiles cannot be imported twice.
    """
    assert numba.njit(abs_of)(-1.0) == 1.0


def abs_of(number: float) -> float:
    """Anything to compile."""
    return abs(number)


@pytest.fixture
def stored(tmp_path):
    """A folder with one whole recording."""
    folder = tmp_path / "stored"
    folder.mkdir()
    shutil.copy(DESCENT, folder / "box.mcap")
    return folder


def test_an_item_for_each_step_of_each_file(pytester, stored):
    pytester.makepyfile("def test_of_the_user(): pass")
    result = pytester.runpytest_inprocess("--replays", str(stored), ".", "-v")
    result.assert_outcomes(passed=5)
    result.stdout.fnmatch_lines(["*box.mcap::step 8, gradient_descent PASSED*"])


def test_without_the_option_recordings_are_no_tests(pytester, stored):
    assert pytester.runpytest_inprocess(str(stored)).ret == pytest.ExitCode.NO_TESTS_COLLECTED


def test_folders_of_the_configuration_are_collected(pytester, stored):
    shutil.copytree(stored, pytester.path / "kept")
    pytester.makeini("[pytest]\nreplays = kept\n")
    pytester.runpytest_inprocess().assert_outcomes(passed=4)
    pytester.runpytest_inprocess("-k", "step and 9").assert_outcomes(passed=1, deselected=3)


def test_a_failing_item_says_what_verify_says(pytester, stored, write):
    events = list(read_recording(DESCENT).events())
    at = [i for i, event in enumerate(events) if isinstance(event, HypothesesFound)][2]
    event = events[at]
    assert isinstance(event, HypothesesFound)
    cost = event.hypotheses.cost * (1.0 + 1e-15)
    changed = dataclasses.replace(event.hypotheses, cost=np.sort(cost))
    events[at] = HypothesesFound(event.step, changed)
    shutil.move(write(measured_again(events)), stored / "changed.mcap")
    result = pytester.runpytest_inprocess("--replays", str(stored))
    result.assert_outcomes(passed=7, failed=1)
    result.stdout.fnmatch_lines(
        [
            "*changed.mcap: step 10, gradient_descent: differs",
            "  first difference: choosing the hypotheses (*",
            "  cost: * of 30 numbers by up to * ulp *",
        ]
    )


def test_a_broken_file_fails_and_the_others_run(pytester, stored):
    (stored / "cut.mcap").write_bytes(DESCENT.read_bytes()[:-100])
    (stored / "empty.mcap").touch()
    result = pytester.runpytest_inprocess("--replays", str(stored))
    result.assert_outcomes(passed=4, failed=2)
    result.stdout.fnmatch_lines(["recording *cut.mcap is unfinished*"])


def test_a_folder_that_does_not_exist_is_one_clear_line(pytester):
    result = pytester.runpytest_inprocess("--replays", "nowhere")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --replays nowhere does not exist*"])


def test_every_object_and_method_has_stored_replays_of_a_modest_size():
    from chsel.methods import METHODS
    from runners.objects.loader import MODELS

    files = list(REPLAYS.glob("*.mcap"))
    sizes = [file.stat().st_size for file in files]
    assert max(sizes) <= 2**20
    assert sum(sizes) <= 15 * 2**20
    starts = [read_recording(file).start for file in files]
    found = {(start.object, start.method) for start in starts}
    chsel = ("chsel", "chsel_cma_me", "gradient_descent")
    assert {(name, method) for name in MODELS for method in chsel} <= found
    for method in METHODS:
        assert len({name for name, stored in found if stored == method}) >= 4, method
    assert any("policy" in start.config for start in starts)
    assert {"simulated", "points"} <= {start.session for start in starts}


def test_a_stored_replay_of_every_method_has_todays_default_settings():
    from chsel.methods import METHODS, preset_settings

    stored = [read_recording(file).start.config["method"] for file in REPLAYS.glob("*.mcap")]
    for method in METHODS:
        settings = settings_mapping(preset_settings(method, "default"))
        expected = json.loads(json.dumps({"name": method, **settings}))
        assert expected in stored, f"{method}: make a stored replay with today's settings"
