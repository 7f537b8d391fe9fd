"""A recorded step again: what is run, what is written, what is said."""

import hashlib
from pathlib import Path

import pytest

from chsel.events import HypothesesFound, SessionEnded
from replay.__main__ import main
from replay.comparing.choices import METHOD, chosen
from replay.comparing.verification import EQUAL, verify
from replay.environment import environment
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import registered_session, write_recording


@pytest.fixture(scope="module")
def session():
    return registered_session("chsel")


@pytest.fixture
def recording(session, tmp_path):
    write_recording(tmp_path / "session.mcap", session)
    return read_recording(tmp_path / "session.mcap")


@pytest.fixture
def step(recording, tmp_path, monkeypatch):
    """Runs the command in an empty folder; its status."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return lambda *words: main(["step", str(recording.path), *words])


def test_the_recorded_method_gives_the_recorded_bits_and_says_where_they_are_from(
    recording, step, capsys
):
    assert step("--step", "1") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "its 1 results are those recorded, to the bit" in said
    again = read_recording("session_step1_chsel.mcap")
    assert again.hypotheses(1).digest == recording.hypotheses(1).digest
    digests = [[a.digest for a in of.snapshots(1)] for of in (recording, again)]
    assert digests[0] == digests[1]
    assert len(digests[0]) > 2
    assert again.steps == (1,)
    assert again.problem(1).digest == recording.problem(1).digest
    assert [probe.step for probe in again.probes] == [0, 1]
    digest = hashlib.blake2b(recording.path.read_bytes(), digest_size=16).hexdigest()
    assert again.start.source == digest
    assert again.start.config["source"] == {
        "step": 1,
        "method": "chsel",
        "hypotheses": recording.hypotheses(1).digest,
    }
    assert again.start.config["method"] == recording.start.config["method"]
    assert again.start.environment == environment()
    assert (again.start.object, again.start.seed) == ("box", 3)
    assert again.start.mesh.vertices.tolist() == recording.start.mesh.vertices.tolist()
    assert again.ended == SessionEnded(1, "finished")
    assert [verdict.outcome for verdict in verify(again)] == [EQUAL]


def test_another_method_with_other_settings_is_recorded_as_such(recording, step, capsys):
    words = ("gradient_descent@paper", "cost.free_scale=40")
    assert step("--step", "1", "--method", *words) == 0
    assert "gradient_descent@paper with cost.free_scale=40" in capsys.readouterr().out
    again = read_recording("session_step1_gradient_descent.mcap")
    config = again.start.config
    assert again.start.method == config["method"]["name"] == "gradient_descent"
    assert config["method"]["cost"]["free_scale"] == 40
    assert config["method"]["descent"]["stop_below"] is None
    assert config["preset"] == {"name": "paper"}
    assert again.problem(1).digest == recording.problem(1).digest
    (choice,) = chosen(recording, METHOD, words=["gradient_descent@paper", "cost.free_scale=40"])
    expected = choice.build().register(recording.problem(1))
    assert again.hypotheses(1).digest == expected.digest != recording.hypotheses(1).digest


def test_a_problem_without_a_result_can_be_registered(session, write, tmp_path, capsys):
    path = write([e for e in session if not (isinstance(e, HypothesesFound) and e.step == 1)])
    assert main(["step", str(path), "--step", "1", "-o", str(tmp_path / "a.mcap")]) == 0
    assert "no result was recorded" in capsys.readouterr().out
    assert read_recording(tmp_path / "a.mcap").start.config["source"]["hypotheses"] is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--step", "2"), "there is no step 2; accepted: 0, 1"),
        (("--step", "1", "--method", "a", "b"), "--method names a and b; accepted: one, then"),
    ],
)
def test_what_does_not_exist_is_named(step, capsys, words, message):
    assert step(*words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not list(Path().iterdir())
