"""`replay accept`: today's results become the expected ones, if wanted."""

from __future__ import annotations

import io
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from chsel.problem import online_registration as online
from replay.__main__ import main
from replay.events import RigDescribed, SensorImage
from replay.mcap.reader import read_recording
from replay.verbs.accept import write_accepted
from tests.replay.conftest import same_bits
from tests.tools.small_recordings import robot_session, write_recording

REPLAYS = Path(__file__).resolve().parents[1] / "replays"


@pytest.fixture
def stored(tmp_path):
    return Path(shutil.copy(REPLAYS / "cracker_box_gradient_descent.mcap", tmp_path / "box.mcap"))


@pytest.fixture
def other_code(monkeypatch):
    """Code that draws the noise of E_0 otherwise."""
    drawn = online.normals
    monkeypatch.setattr(online, "normals", lambda stream, shape: -drawn(stream, shape))


@pytest.mark.parametrize("verb", ["accept", "bless"])  # its former name
def test_nothing_changes_where_all_bits_are_equal(verb, stored, capsys):
    before = stored.read_bytes()
    assert main([verb, str(stored), "--yes"]) == 0
    assert "all 4 results are as recorded, nothing to change" in capsys.readouterr().out
    assert stored.read_bytes() == before
    assert list(stored.parent.iterdir()) == [stored]


@pytest.mark.usefixtures("other_code")
def test_todays_results_are_those_that_verify_then_expects(stored, capsys):
    recorded = read_recording(stored)
    assert main(["verify", str(stored)]) == 1
    (report,) = re.findall(
        r"^step 9, .*\n.* making E_0 .*\n  E_0: .*\n", capsys.readouterr().out, re.M
    )
    assert main(["accept", str(stored), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert report in shown  # the same differences, from the same comparison
    assert "3 of 4 results change" in shown  # the first E_0 has no noise
    assert "best cost" in shown
    assert main(["verify", str(stored)]) == 0
    accepted = read_recording(stored)
    assert accepted.steps == recorded.steps
    assert accepted.hypotheses(8).digest == recorded.hypotheses(8).digest
    assert accepted.hypotheses(9).digest != recorded.hypotheses(9).digest
    for step in accepted.steps:
        points = (accepted.problem(step).points, recorded.problem(step).points)
        assert points[0].digest == points[1].digest
    assert not np.array_equal(accepted.problem(9).initial_set, recorded.problem(9).initial_set)
    assert list(stored.parent.iterdir()) == [stored]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("other_code")
@pytest.mark.parametrize(("answer", "status"), [("n\n", 1), ("\n", 1), ("y\n", 0)])
def test_it_asks(stored, answer, status, monkeypatch):
    before = stored.read_bytes()
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert main(["accept", str(stored)]) == status
    assert (stored.read_bytes() == before) is (status == 1)
    assert list(stored.parent.iterdir()) == [stored]


def test_where_nobody_can_answer_nothing_is_done(stored, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert main(["accept", str(stored)]) == 2
    assert capsys.readouterr().err == "error: nobody can be asked here; accepted: --yes\n"


def test_a_broken_recording_is_left_alone(tmp_path, stored, capsys):
    stored.write_bytes(stored.read_bytes()[:-9])
    before = stored.read_bytes()
    assert main(["accept", str(stored), "--yes"]) == 2
    assert stored.read_bytes() == before
    assert "is unfinished" in capsys.readouterr().err


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    found = tmp_path_factory.mktemp("robot") / "robot.mcap"
    write_recording(found, robot_session("gradient_descent"))
    return found


def test_it_is_verified_stepped_and_compared(path, tmp_path, capsys):
    assert main(["verify", str(path)]) == 0
    assert main(["step", str(path), "--step", "1", "-o", str(tmp_path / "step.mcap")]) == 0
    assert [probe.step for probe in read_recording(tmp_path / "step.mcap").probes] == [0, 1]
    assert main(["compare", str(path), "--methods", "gradient_descent"]) == 0
    capsys.readouterr()


def test_accepting_it_keeps_its_rig_and_images(path, tmp_path):
    new = tmp_path / "new.mcap"
    write_accepted(read_recording(path), new)
    kept, before = (list(read_recording(file).events()) for file in (new, path))
    of_sensors = [event for event in before if isinstance(event, RigDescribed | SensorImage)]
    found = [event for event in kept if isinstance(event, RigDescribed | SensorImage)]
    assert len(found) == 5
    assert all(map(same_bits, found, of_sensors))
