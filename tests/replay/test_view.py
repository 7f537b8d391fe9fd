"""The Rerun recording, made anew from the MCAP file alone."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rerun.blueprint.components import PlayState

from replay import __main__
from replay.mcap.reader import read_recording
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import draw_recording
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


@pytest.fixture(scope="module", params=["kinematic", "gradient_descent"])
def run_folder(request, tmp_path_factory):
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


def test_it_is_equal_to_the_one_that_the_run_wrote(run_folder, tmp_path):
    recording = read_recording(run_folder / "recording.mcap")
    draw_recording(recording, tmp_path / "again.rrd")
    written, again = run_folder / "recording.rrd", tmp_path / "again.rrd"
    rows = read(written)
    np.testing.assert_equal(read(again), rows)
    assert views_of_the_last_layout(again) == views_of_the_last_layout(written)
    assert len(rows["/scene/hypotheses/best"]) > len(recording.steps)


def test_save_writes_a_new_file_and_opens_nothing(events, tmp_path, write, capsys):
    file, saved = write(events), tmp_path / "saved.rrd"
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 0
    assert capsys.readouterr().out.strip() == str(saved)
    draw_recording(read_recording(file), tmp_path / "drawn.rrd")
    np.testing.assert_equal(read(saved), read(tmp_path / "drawn.rrd"))
    before = saved.read_bytes()
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 2
    assert "saved.rrd exists; accepted: the name of a new file" in capsys.readouterr().err
    assert saved.read_bytes() == before


def test_nothing_after_the_step_asked_for_is_saved(events, tmp_path, write, capsys):
    file, saved = str(write(events)), tmp_path / "saved.rrd"
    assert __main__.main(["view", file, "--save", str(saved), "--step", "7"]) == 2
    assert "has no probe 7; accepted: 0 to 2" in capsys.readouterr().err
    assert not saved.exists()
    assert __main__.main(["view", file, "--save", str(saved), "--step", "1"]) == 0
    probes = {times.get("probe", 0) for rows in read(saved).values() for times, _ in rows}
    assert max(probes) == 1
    assert opens_at(saved) == ("probe", PlayState.Following)  # at that probe, the last


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a screen")
def test_without_a_screen_the_other_ways_are_named(events, write, monkeypatch, capsys):
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)
    assert __main__.main(["view", str(write(events))]) == 2
    error = capsys.readouterr().err
    assert "there is no screen" in error
    assert "accepted: --save OUT.rrd, or --web" in error


def test_a_viewer_that_does_not_start_says_why(events, tmp_path, write, monkeypatch, capsys):
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
    events, tmp_path, write, ending, status
):
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
