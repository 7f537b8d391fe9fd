"""What the writer puts into a file, and what becomes of it when the process does not end well."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chsel.errors import RecordingError
from chsel.events import HypothesesFound, ProblemPosed
from chsel.problem.points import KnownPoints
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.replay.conftest import changed, nth

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def run_script(script, path, *, hash_seed="0"):
    """Run a script that finds the example's functions in `example` and a path in `path`."""
    head = f"import runpy; example = runpy.run_path({str(CONFTEST)!r}); path = {str(path)!r}\n"
    return subprocess.run(
        [sys.executable, "-c", head + script],
        env={**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_equal_sessions_give_equal_bytes_in_processes_with_other_hash_seeds(tmp_path, events):
    script = """
from replay.mcap.writer import McapRecorder
recorder = McapRecorder(path)
for event in example["example_events"]():
    recorder.record(event)
recorder.close()
"""
    result = run_script(script, tmp_path / "a.mcap", hash_seed="1")
    assert result.returncode == 0, result.stderr
    recorder = McapRecorder(tmp_path / "b.mcap")
    for event in events:
        recorder.record(event)
    recorder.close()
    recorder.close()
    data = (tmp_path / "a.mcap").read_bytes()
    assert len(data) > 10_000
    assert (tmp_path / "b.mcap").read_bytes() == data


def test_a_full_disk_is_one_clear_error_and_what_was_flushed_stays(tmp_path, events, assert_same):
    path = tmp_path / "full.mcap"
    script = """
import resource
from chsel.errors import RecordingError
from replay.mcap.writer import McapRecorder
events = example["example_events"](steps=40)
recorder = McapRecorder(path)
try:
    for event in events:
        recorder.record(event)
        if type(event).__name__ == "Measured":
            recorder.flush()
            resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, -1))
except RecordingError as error:
    print(error)
recorder.close()
recorder.flush()
"""
    result = run_script(script, path)
    assert result.stderr == ""
    assert result.stdout == f"recording {path} cannot be written: File too large\n"
    recording = read_recording(path, partial=True)
    assert_same(list(recording.events())[:11], events[:11])


def test_a_recording_that_exists_is_not_overwritten_nor_a_folder_made(tmp_path):
    path = tmp_path / "recording.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"recording\.mcap cannot be written: File exists"):
        McapRecorder(path)
    assert path.read_bytes() == b"precious"
    with pytest.raises(RecordingError, match="cannot be written: No such file or directory"):
        McapRecorder(tmp_path / "nowhere" / "recording.mcap")


def test_what_cannot_be_recorded_leaves_a_whole_file_of_all_before_it(
    tmp_path, events, assert_same
):
    problem = nth(events, ProblemPosed).problem
    posed = events.index(nth(events, ProblemPosed))
    extra = problem.points.merged(KnownPoints(free=[[0.0, 0.0, 0.0]]))
    found = nth(events, HypothesesFound).hypotheses
    narrow = dataclasses.replace(found, cell=found.cell.astype(np.int32))
    short = dataclasses.replace(found, cost=found.cost[:4])
    for count, event, message in (
        (posed, events[0], "needs one SessionStarted, as first event"),
        (
            posed,
            ProblemPosed(1, dataclasses.replace(problem, points=extra)),
            "problem of step 1 has points",
        ),
        (posed + 1, HypothesesFound(1, narrow), r"Hypotheses\.cell .* int32 \(5,\); .*int64 \(5\)"),
        (posed + 1, HypothesesFound(1, short), "step 1: it has a value of another shape or type"),
    ):
        path = tmp_path / "recording.mcap"
        recorder = McapRecorder(path)
        for before in events[:count]:
            recorder.record(before)
        with pytest.raises(RecordingError, match=message):
            recorder.record(event)
        recorder.close()
        assert_same(read_recording(path).events(), events[:count])
        path.unlink()


def test_an_archive_unlike_the_last_snapshot_is_stored(events, write, assert_same):
    old = nth(events, HypothesesFound)
    archive = dataclasses.replace(old.hypotheses.archive, refinement=2)
    other = dataclasses.replace(old.hypotheses, archive=archive)
    again = changed(events, old, hypotheses=other)
    assert_same(read_recording(write(again)).events(), again)
