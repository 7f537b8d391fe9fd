"""`replay bless`: today's results become the expected ones, if wanted."""

from __future__ import annotations

import dataclasses
import io
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from chsel.plausible.plausible_file import save_plausible
from chsel.plausible.plausible_set import plausible_set
from chsel.plausible.plausible_settings import plausible_settings
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.problem import online_registration as online
from chsel.problem.poses import axis_angle, inverse
from chsel.problem.registration_problem import Hypotheses
from replay.__main__ import main
from replay.blessing import _change
from replay.mcap.reader import read_recording

REPLAYS = Path(__file__).resolve().parents[1] / "replays"


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    return Path(shutil.copy(REPLAYS / "cracker_box_gradient_descent.mcap", tmp_path / "box.mcap"))


@pytest.fixture
def other_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code that draws the noise of E_0 otherwise."""
    drawn = online.normals
    monkeypatch.setattr(online, "normals", lambda stream, shape: -drawn(stream, shape))


def test_nothing_changes_where_all_bits_are_equal(
    stored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = stored.read_bytes()
    assert main(["bless", str(stored), "--yes"]) == 0
    assert "all 4 results are as recorded, nothing to change" in capsys.readouterr().out
    assert stored.read_bytes() == before
    assert list(stored.parent.iterdir()) == [stored]


@pytest.mark.usefixtures("other_code")
def test_todays_results_are_those_that_verify_then_expects(
    stored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = read_recording(stored)
    assert main(["verify", str(stored)]) == 1
    assert main(["bless", str(stored), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert "3 of 4 results change" in shown  # the first E_0 has no noise
    assert "best cost" in shown
    assert main(["verify", str(stored)]) == 0
    blessed = read_recording(stored)
    assert blessed.steps == recorded.steps
    assert blessed.hypotheses(8).digest == recorded.hypotheses(8).digest
    assert blessed.hypotheses(9).digest != recorded.hypotheses(9).digest
    for step in blessed.steps:
        points = (blessed.problem(step).points, recorded.problem(step).points)
        assert points[0].digest == points[1].digest
    assert not np.array_equal(blessed.problem(9).initial_set, recorded.problem(9).initial_set)
    assert list(stored.parent.iterdir()) == [stored]


@pytest.mark.usefixtures("other_code")
def test_diversity_is_told_where_plausible_sets_lie_beside_it(
    stored: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    recording = read_recording(stored)
    truth = recording.start.world_from_object
    assert truth is not None
    members = plausible_set(recording.problem(9), truth, plausible_settings("default", 0.002))
    save_plausible(stored.parent / "plausible", members)
    assert main(["bless", str(stored), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert "PD, mm²" in shown
    (row,) = (line for line in shown.splitlines() if line.split()[:1] == ["9"])
    before, after = (float(number) for number in row.split()[-3::2])
    assert before != after
    assert before > 0.0


def test_results_without_poses_are_compared_as_well(stored: Path) -> None:
    recording = read_recording(stored)
    found = recording.hypotheses(9)
    nothing = Hypotheses(
        found.object_from_world[:0],
        found.cost[:0],
        found.duplicate[:0],
        found.cell[:0],
        found.elites[:0],
        None,
    )
    truth = recording.start.world_from_object
    for pair in [(found, nothing), (nothing, found), (nothing, nothing)]:
        symmetry = object_symmetry(recording.start.mesh)
        change = _change(9, *pair, truth, [{}, {}], symmetry=symmetry, equal=False)
        assert np.isnan(change.position)
        assert change.position_error is None
        assert change.distinct == tuple(one.distinct for one in pair)


@pytest.mark.parametrize("better", [False, True])
def test_errors_stand_as_before_and_after(stored: Path, better: bool) -> None:
    """A result that is 10 mm and 0.1 rad off becomes one that is 30 mm and 0.4 rad off, or back."""
    recording = read_recording(stored)
    start, found = recording.start, recording.hypotheses(9)
    truth = start.world_from_object
    assert truth is not None

    def off_by(metres: float, radians: float) -> Hypotheses:
        pose = truth.copy()
        turn = axis_angle(np.array([[0.0, 0.0, 1.0]]), np.array([radians]))[0]
        pose[:3, :3] = turn @ truth[:3, :3]
        pose[:3, 3] += [metres, 0.0, 0.0]
        return dataclasses.replace(found, object_from_world=inverse(pose[None]), cost=np.zeros(1))

    pair = [off_by(0.01, 0.1), off_by(0.03, 0.4)]
    errors = [(0.01, 0.1), (0.03, 0.4)]
    if better:
        pair.reverse()
        errors.reverse()
    sets = [{"diversity": 1.0}, {"diversity": 2.0}]
    change = _change(9, *pair, truth, sets, symmetry=ObjectSymmetry(), equal=False)
    positions, rotations = zip(*errors, strict=True)
    assert change.position_error == pytest.approx(positions, abs=1e-9)
    assert change.rotation_error == pytest.approx(rotations, abs=1e-9)
    assert change.diversity == (1.0, 2.0)
    assert change.rotation == pytest.approx(0.3, abs=1e-9)
    assert change.position == pytest.approx(0.02, abs=1e-9)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("other_code")
@pytest.mark.parametrize(("answer", "status"), [("n\n", 1), ("\n", 1), ("y\n", 0)])
def test_it_asks(stored: Path, answer: str, status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    before = stored.read_bytes()
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert main(["bless", str(stored)]) == status
    assert (stored.read_bytes() == before) is (status == 1)
    assert list(stored.parent.iterdir()) == [stored]


def test_where_nobody_can_answer_nothing_is_done(
    stored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert main(["bless", str(stored)]) == 2
    assert capsys.readouterr().err == "error: nobody can be asked here; accepted: --yes\n"


def test_a_broken_recording_is_left_alone(
    tmp_path: Path, stored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored.write_bytes(stored.read_bytes()[:-9])
    before = stored.read_bytes()
    assert main(["bless", str(stored), "--yes"]) == 2
    assert stored.read_bytes() == before
    assert "is unfinished" in capsys.readouterr().err
