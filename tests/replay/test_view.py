"""The Rerun recording, made anew from the MCAP file alone."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rerun.blueprint.components import PlayState

from chsel.errors import RecordingError
from replay import __main__
from replay.events import Event, SessionStarted
from replay.mcap.reader import read_recording
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import RerunRecorder, draw_recording
from tests.tools.rrd_rows import opens_at, read, views_of_the_last_layout

QUICK = ("recording=both", "recording.snapshot_interval=5")
KINEMATIC = (
    "object=drill",
    "session=kinematic",
    "session.object_resolution=0.02",
    "session.start_probe=22",
    "method.descent.restarts=2",
    "method.descent.iterations=20",
    "method.emitter.iterations=10",
    "method.archive.bins=10",
)
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in SCREENS}
Write = Callable[[list[Event]], Path]


@pytest.fixture(scope="module", params=["kinematic", "gradient_descent"])
def run_folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both recordings of a small session: of probes, or of points with times and no true pose."""
    folder = tmp_path_factory.mktemp(request.param)
    timed_descent = ("method=gradient_descent", "recording.timings=true")
    choices = {"kinematic": KINEMATIC, "gradient_descent": (*points(folder), *timed_descent)}
    command = [
        sys.executable,
        "-m",
        "runners.probe",
        *QUICK,
        *choices[request.param],
        f"logs={folder / 'logs'}",
    ]
    subprocess.run(command, check=True, capture_output=True, env=ENVIRONMENT)
    (found,) = (folder / "logs" / "probe").iterdir()
    return found


def points(folder: Path) -> tuple[str, ...]:
    """A session of three steps on a can."""
    can = trimesh.creation.cylinder(0.04, 0.2, sections=37)
    surface = trimesh.sample.sample_surface(can, 15, seed=0)[0]
    np.savez(folder / "can.npz", surface=surface, surface_step=np.arange(15) // 5)
    can.export(folder / "can.ply")
    object_choice = ("object=mesh", f"object.path={folder / 'can.ply'}")
    return ("session=points", f"session.path={folder / 'can.npz'}", *object_choice)


def test_it_is_equal_to_the_one_that_the_run_wrote(run_folder: Path, tmp_path: Path) -> None:
    recording = read_recording(run_folder / "recording.mcap")
    draw_recording(recording, tmp_path / "again.rrd")
    written, again = run_folder / "recording.rrd", tmp_path / "again.rrd"
    rows = read(written)
    np.testing.assert_equal(read(again), rows)
    assert views_of_the_last_layout(again) == views_of_the_last_layout(written)
    assert len(rows["/scene/hypotheses/best"]) > len(recording.steps)


def test_what_an_mcap_file_does_not_keep_is_not_drawn(
    events: list[Event], tmp_path: Path, write: Write
) -> None:
    start = events[0]
    assert isinstance(start, SessionStarted)
    upward = np.tile([0.0, 0.0, 1.0], (len(start.mesh.vertices), 1))
    mesh = trimesh.Trimesh(start.mesh.vertices, start.mesh.faces, vertex_normals=upward)
    shared = [1, 2]
    start = dataclasses.replace(start, mesh=mesh, config={"a": shared, "b": shared})
    recorder = RerunRecorder(tmp_path / "a.rrd")
    recorder.record(start)
    recorder.close()
    draw_recording(read_recording(write([start])), tmp_path / "b.rrd")
    np.testing.assert_equal(read(tmp_path / "b.rrd"), read(tmp_path / "a.rrd"))


def test_save_writes_a_new_file_and_opens_nothing(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = write(events), tmp_path / "saved.rrd"
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 0
    assert capsys.readouterr().out.strip() == str(saved)
    draw_recording(read_recording(file), tmp_path / "drawn.rrd")
    np.testing.assert_equal(read(saved), read(tmp_path / "drawn.rrd"))
    before = saved.read_bytes()
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 2
    assert "saved.rrd exists; accepted: the name of a new file" in capsys.readouterr().err
    assert saved.read_bytes() == before


def test_nothing_after_the_step_asked_for_is_saved(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = str(write(events)), tmp_path / "saved.rrd"
    assert __main__.main(["view", file, "--save", str(saved), "--step", "7"]) == 2
    assert "has no probe 7; accepted: 0 to 2" in capsys.readouterr().err
    assert not saved.exists()
    assert __main__.main(["view", file, "--save", str(saved), "--step", "1"]) == 0
    probes = {times.get("probe", 0) for rows in read(saved).values() for times, _ in rows}
    assert max(probes) == 1
    assert opens_at(saved) == ("probe", PlayState.Following)  # at that probe, the last


def test_what_is_whole_of_an_unfinished_file_is_drawn_with_a_warning(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = write(events), tmp_path / "saved.rrd"
    file.write_bytes(file.read_bytes()[:-1])
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 0
    assert "is unfinished; what is whole of it is shown" in capsys.readouterr().err
    whole = read_recording(file, partial=True)
    assert len(list(whole.events())) == len(events)
    assert "/scene/hypotheses/best" in read(saved)


def test_nothing_is_left_of_a_file_that_cannot_be_drawn(
    events: list[Event], tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_recording(write(events))

    def some_events() -> Iterator[Event]:
        yield events[0]
        raise RecordingError("the problem of step 1 is not the recorded one")

    monkeypatch.setattr(recording, "events", some_events)
    with pytest.raises(RecordingError, match="is not the recorded one"):
        draw_recording(recording, tmp_path / "a.rrd")
    assert not (tmp_path / "a.rrd").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a screen")
def test_without_a_screen_the_other_ways_are_named(
    events: list[Event],
    write: Write,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)
    assert __main__.main(["view", str(write(events))]) == 2
    error = capsys.readouterr().err
    assert "there is no screen" in error
    assert "accepted: --save OUT.rrd, or --web" in error


def test_a_viewer_that_does_not_start_says_why(
    events: list[Event],
    tmp_path: Path,
    write: Write,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\necho no graphics today\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr(rerun_viewer, "viewer_program", lambda: program)
    monkeypatch.setenv("DISPLAY", ":99")
    file = str(write(events))
    assert __main__.main(["view", file]) == 2
    assert "the Rerun viewer does not start: no graphics today" in capsys.readouterr().err


@pytest.mark.usefixtures("interruptible")
@pytest.mark.skipif(os.name == "nt", reason="there are no such signals on Windows")
@pytest.mark.parametrize(("ending", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_web_viewer_is_served_here_alone_and_ends_with_the_command(
    events: list[Event], tmp_path: Path, write: Write, ending: signal.Signals, status: int
) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    command = [sys.executable, "-m", "replay", "view", str(write(events)), "--web"]
    environment = {**ENVIRONMENT, "TMPDIR": str(folder), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as viewing:
        try:
            assert viewing.stdout is not None
            address = viewing.stdout.readline().strip()
            page, data = map(int, re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address))
            with urllib.request.urlopen(f"http://127.0.0.1:{page}/") as answer:
                assert b"<html" in answer.read()
            assert rerun_viewer.is_listening(data)
            assert [file.name for file in folder.rglob("*.rrd")] == ["recording.rrd"]
            viewing.send_signal(ending)
            assert viewing.wait(30.0) == status
        finally:
            viewing.kill()  # else the block would wait for one that a failure has left behind
    assert not rerun_viewer.is_listening(page)
    assert not rerun_viewer.is_listening(data)
    assert list(folder.iterdir()) == []
