"""Sessions side by side, probe by probe, as an animation."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from chsel.problem.poses import apply
from replay.mcap.reader import read_recording
from replay.rerun.meshes import deepest
from runners.reporting import probing_animation
from runners.reporting.probing_animation import (
    Moment,
    ProbingAnimation,
    ShownSession,
    moments,
)
from runners.reporting.silhouette import Oblique
from tests.runners.made_up_evaluations import REPLAYS

CHSEL = REPLAYS / "mustard_chsel.mcap"  # four probes, results after the last two
CLAMP, CLAMP_DESCENT = (REPLAYS / f"clamp_{name}.mcap" for name in ("chsel", "gradient_descent"))


def shown(path: Path, title: str = "a", color: str = "#0072b2") -> ShownSession:
    return ShownSession.of(read_recording(path), title, color)


def test_frames_show_the_way_of_each_probe_until_a_session_has_ended_then_only_its_end() -> None:
    found = list(moments([1, 3]))
    assert [(m.done, m.on_the_way) for m in found] == [
        *((0, part) for part in (0.4, 0.75, 1.0)),
        *((done, 0.0) for done in (1, 2, 3)),
    ]
    assert found[-1].milliseconds > 5 * found[-2].milliseconds


def test_the_error_is_that_of_all_hypotheses_to_the_true_pose() -> None:
    session, recording = shown(CHSEL), read_recording(CHSEL)
    truth = session.start.world_from_object
    assert truth is not None
    found = recording.hypotheses(3)
    kept = found.object_from_world[~found.duplicate]
    vertices = np.asarray(session.start.mesh.sample(300, seed=0))
    world = vertices @ truth[:3, :3].T + truth[:3, 3]
    far = [session.start.mesh.nearest.on_surface(world @ p[:3, :3].T + p[:3, 3])[1] for p in kept]
    expected = 1e3 * np.sqrt((np.array(far) ** 2).mean())
    assert session.errors[3] == pytest.approx(expected, rel=0.1)
    assert session.curve(3).tolist() == [[3.0, session.errors[2]]]


def test_a_frame_has_poses_contacts_paths_and_errors_of_each_session() -> None:
    sessions = [shown(CLAMP), shown(CLAMP_DESCENT, "b", "#d55e00")]
    figure = ProbingAnimation(sessions).figure(Moment(9, 0.75, 0))
    left, right, curves = figure.axes
    assert left.get_title() == f"a: 9 probes, error {sessions[0].errors[8]:.0f} mm"
    assert right.get_title() == f"b: 9 probes, error {sessions[1].errors[8]:.0f} mm"
    for panel, session in ((left, sessions[0]), (right, sessions[1])):
        (contacts,) = (line for line in panel.lines if line.get_marker() == "o")
        assert len(contacts.get_xydata()) == len(session.contacts[8])
        outlines = len(panel.collections)
        assert outlines == len(session.poses[8]) + 1  # and the true pose
        ways = [line for line in panel.lines if line.get_color() in ("#aaaaaa", "#555555")]
        assert [line.get_color() for line in ways] == ["#aaaaaa"] * 9 + ["#555555"]
    drawn = [line.get_xydata().tolist() for line in curves.lines]
    assert drawn == [session.curve(9).tolist() for session in sessions]


def test_the_hand_is_drawn_where_it_is_and_its_forecast_ahead_of_it() -> None:
    met = np.array([[0.1, 0.0, 0.2], [0.2, 0.1, 0.2]])
    hand = trimesh.creation.box(extents=(0.05, 0.1, 0.1))
    session = replace(shown(CLAMP), hand=hand, forecasts={9: met})
    drawn, path = ProbingAnimation([session]), session.probes[9].gripper_path
    panel, _ = drawn.figure(Moment(9, 1.0, 0)).axes
    (dots,) = (line for line in panel.lines if line.get_marker() == ".")
    frame = Oblique((0, 1), np.zeros(2), np.ones(2))
    np.testing.assert_allclose(dots.get_xydata(), frame.flat(met))
    fill = np.concatenate([path.vertices for path in panel.collections[-1].get_paths()])
    corners = frame.flat(apply(path[deepest(path)], hand.vertices))
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(fill, axis=0), end(corners, axis=0), atol=0.015)
    after, _ = drawn.figure(Moment(10, 0.0, 0)).axes
    assert len(after.collections) == len(session.poses[9]) + 1  # no hand
    assert "." not in [line.get_marker() for line in after.lines]


def test_the_command_writes_an_animation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(probing_animation, "_ON_THE_WAY", (1.0,))
    monkeypatch.setattr(probing_animation, "_DPI", 40)
    out = tmp_path / "a.webp"
    monkeypatch.setattr(sys, "argv", ["probing_animation", str(out), f"chsel={CHSEL}"])
    assert probing_animation.main() == 0
    assert capsys.readouterr().out == f"written: {out}\n"
    with Image.open(out) as picture:
        assert (picture.format, picture.size) == ("WEBP", (360, 264))
        assert picture.n_frames == 5  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("out", "sessions", "message"),
    [
        ("a.webp", [str(CHSEL)], "has no title; accepted: TITLE=RECORDING"),
        ("a.gif", [f"a={CHSEL}"], "suffix of the animation"),
        ("a.webp", ["a=none.mcap"], "none.mcap"),
        ("a.webp", [f"a={CHSEL}"] * 4, "4 sessions are named; accepted: at most 3"),
        ("a.webp", [f"a={CHSEL}", f"b={REPLAYS / 'drill_chsel.mcap'}"], "accepted: mustard"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    out: str,
    sessions: list[str],
    message: str,
) -> None:
    monkeypatch.setattr(sys, "argv", ["probing_animation", str(tmp_path / out), *sessions])
    assert probing_animation.main() == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())
