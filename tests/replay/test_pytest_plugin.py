"""Stored replays as items of pytest, and what is stored."""

import dataclasses
import json
import shutil
from pathlib import Path

import numba
import pytest

from chsel.events import Decided
from chsel.methods import METHODS, preset_settings
from chsel.problem.settings import settings_mapping
from replay.mcap.reader import read_recording
from runners.objects.loader import MODELS
from tests.replay.conftest import changed, nth

pytest_plugins = ["pytester"]
REPLAYS = Path(__file__).resolve().parents[1] / "replays"
DESCENT = REPLAYS / "cracker_box_gradient_descent.mcap"


@pytest.fixture(autouse=True, scope="module")
def _numba_as_a_whole():
    """Modules that are first imported within a test of pytester are forgotten after it.

    What numba imports when it first compiles cannot be imported twice.
    """
    assert numba.njit(abs_of)(-1.0) == 1.0


def abs_of(number):
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


def test_folders_of_the_configuration_alone_are_collected(pytester, stored):
    assert pytester.runpytest_inprocess(str(stored)).ret == pytest.ExitCode.NO_TESTS_COLLECTED
    shutil.copytree(stored, pytester.path / "kept")
    pytester.makeini("[pytest]\nreplays = kept\n")
    pytester.runpytest_inprocess("-k", "step and 9").assert_outcomes(passed=1, deselected=3)


def test_a_failing_item_says_what_verify_says(pytester, steered, write, tmp_path):
    old = nth(steered, Decided, number=2)
    decision = dataclasses.replace(old.decision, score=old.decision.score * 2.0)
    folder = tmp_path / "kept"
    folder.mkdir()
    shutil.move(write(changed(steered, old, decision=decision)), folder / "box.mcap")
    result = pytester.runpytest_inprocess("--replays", str(folder), "-v")
    result.assert_outcomes(passed=6, failed=1)
    result.stdout.fnmatch_lines(
        [
            "*box.mcap::decision after step 1, information FAILED*",
            "*box.mcap: decision after step 1, information: differs",
            "  first difference: score (*",
            "  score: * of 8 numbers by up to * ulp *",
        ]
    )


def test_a_broken_file_fails_and_the_others_run(pytester, stored):
    (stored / "cut.mcap").write_bytes(DESCENT.read_bytes()[:-100])
    (stored / "empty.mcap").touch()
    result = pytester.runpytest_inprocess("--replays", str(stored), "-k", "8 or recording")
    result.assert_outcomes(passed=1, failed=2, deselected=3)
    result.stdout.fnmatch_lines(["recording *cut.mcap is unfinished*"])


def test_every_object_and_method_has_stored_replays_of_a_modest_size():
    files = list(REPLAYS.glob("*.mcap"))
    sizes = [file.stat().st_size for file in files]
    assert max(sizes) <= 2**20
    assert sum(sizes) <= 15 * 2**20
    starts = [read_recording(file).start for file in files]
    found = {(start.object, start.method) for start in starts}
    chsel = ("chsel", "chsel_cma_me", "gradient_descent")
    assert {(name, method) for name in MODELS for method in chsel} <= found
    settings = [start.config["method"] for start in starts]
    for method in METHODS:
        assert len({name for name, stored in found if stored == method}) >= 4, method
        today = settings_mapping(preset_settings(method, "default"))
        expected = json.loads(json.dumps({"name": method, **today}))
        assert expected in settings, f"{method}: make a stored replay with today's settings"
    assert any("policy" in start.config for start in starts)
    assert {"simulated", "points"} <= {start.session for start in starts}
