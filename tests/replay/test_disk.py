"""Files that survive a power cut, and errors that name the file that could not be written."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from chsel.errors import RecordingError
from chsel.problem import online_registration as online
from replay.__main__ import main
from replay.files import WritingError, new_file, whole_file
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.tools.kill_sessions import PROBES, points_session, reported_probes

REPOSITORY = Path(__file__).resolve().parents[2]
STORED = REPOSITORY / "tests" / "replays" / "spam_can_icp.mcap"


@dataclass
class Synced:
    """What was synced to the disk: of files the size then, by inode; of folders the names then."""

    sizes: dict[int, int] = field(default_factory=dict)
    names: dict[int, list[str]] = field(default_factory=dict)

    def holds(self, path: Path) -> bool:
        """Whether a file as it is now, and then its name, are on the disk."""
        there = path.stat()
        named = path.name in self.names.get(path.parent.stat().st_ino, [])
        return named and self.sizes.get(there.st_ino) == there.st_size


@pytest.fixture
def synced(monkeypatch):
    """Follows os.fsync."""
    found = Synced()

    def fsync(number: int) -> None:
        there = os.fstat(number)
        if os.path.isdir(f"/proc/self/fd/{number}"):
            found.names[there.st_ino] = os.listdir(number)
        else:
            found.sizes[there.st_ino] = there.st_size

    monkeypatch.setattr(os, "fsync", fsync)
    return found


def test_a_recording_is_on_the_disk_when_it_is_closed(events, tmp_path, synced):
    path = tmp_path / "recording.mcap"
    recorder = McapRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.flush()
    assert not synced.holds(path)  # a step waits for no disk
    recorder.close()
    assert synced.holds(path)


def test_a_recording_that_does_not_get_to_the_disk_is_an_error(events, tmp_path, monkeypatch):
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = McapRecorder(tmp_path / "recording.mcap")
    monkeypatch.setattr(os, "fsync", fail)
    recorder.record(events[0])
    with pytest.raises(RecordingError, match=r"mcap cannot be written.*Input/output error"):
        recorder.close()


def test_recovered_and_accepted_recordings_are_on_the_disk(tmp_path, synced, monkeypatch):
    out = tmp_path / "out.mcap"
    assert main(["recover", str(STORED), "-o", str(out)]) == 0
    assert synced.holds(out)
    assert main(["export", str(STORED), "--what", "points", "-o", str(tmp_path / "a.npz")]) == 0
    assert synced.holds(tmp_path / "a.npz")

    drawn = online.normals
    monkeypatch.setattr(online, "normals", lambda stream, shape: -drawn(stream, shape))
    accepted = Path(shutil.copy(STORED, tmp_path / "accepted.mcap"))
    before = accepted.stat().st_ino
    synced.names.clear()
    assert main(["accept", str(accepted), "--yes"]) == 0
    assert accepted.stat().st_ino != before
    assert synced.holds(accepted)


@pytest.mark.parametrize("make", [whole_file, new_file])
def test_new_files_are_on_the_disk_and_a_full_one_is_named(make, tmp_path, synced):
    path = tmp_path / "out.txt"
    with make(path) as beside:
        beside.write_text("text")
    assert synced.holds(path)
    full = tmp_path / "full.txt"
    with (
        pytest.raises((RecordingError, WritingError), match=r"full\.txt cannot be written.*space"),
        make(full),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert sorted(os.listdir(tmp_path)) == ["out.txt"]


ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"}
SEEDS = (1, 2)  # one for each of two processes
KILLS = 30  # in each; thousands by hand, see kill_sessions


@pytest.mark.slow
def test_every_reported_probe_survives_kills_at_random_moments():
    """In processes of their own: a fork needs one without the threads of other tests."""
    command = [sys.executable, "-m", "tests.tools.kill_sessions", "--count", str(KILLS), "--seed"]
    running = [
        subprocess.Popen(
            [*command, str(seed)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=ENVIRONMENT,
            cwd=Path(__file__).resolve().parents[2],
        )
        for seed in SEEDS
    ]
    for process in running:
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
        figures = re.match(
            r"(\d+) kills, (\d+) before .*, (\d+) after .*; (\d+) probes reported, (\d+) recovered",
            output,
        )
        assert figures is not None, output
        kills, without, ended, reported, recovered = map(int, figures.groups())
        assert kills == KILLS
        assert without + ended < 0.7 * kills  # most kills came in between
        assert kills < reported <= recovered


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    overrides = points_session(tmp_path_factory.mktemp("points"))
    return (*overrides, "method=chsel", "method.descent.restarts=2", "method.descent.iterations=20")


@pytest.mark.slow
@pytest.mark.parametrize("probes", [1, 3, 5])
def test_a_killed_command_leaves_both_files_readable(session, tmp_path, capsys, probes):
    command = [sys.executable, "-u", "-m", "runners.probe", *session, f"logs={tmp_path}"]
    slow = ["method.emitter.iterations=2000", "recording=both"]  # so that the kill is not too late
    process = subprocess.Popen(
        [*command, *slow], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
    )
    assert process.stdout is not None
    output = ""
    for line in process.stdout:
        output += line
        if reported_probes(output) == probes:
            time.sleep(np.random.default_rng(probes).uniform(0.0, 0.05))
            process.send_signal(signal.SIGKILL)
            break
    output += process.stdout.read()
    assert process.wait(timeout=60) == -signal.SIGKILL
    reported = reported_probes(output)
    assert probes <= reported <= PROBES
    (path,) = tmp_path.rglob("recording.mcap")
    assert main(["recover", str(path), "-o", str(tmp_path / "recovered.mcap")]) == 0
    recovered = read_recording(tmp_path / "recovered.mcap")
    assert f"kept: {len(recovered.probes)} probes" in capsys.readouterr().out
    assert [probe.step for probe in recovered.probes][:reported] == list(range(reported))
    for step in range(reported):
        assert recovered.problem(step).points.count > 0
        assert recovered.hypotheses(step).object_from_world.shape == (30, 4, 4)
    chunks = RrdReader(path.with_suffix(".rrd")).stream().to_chunks()
    assert any("hypotheses" in chunk.entity_path for chunk in chunks)
