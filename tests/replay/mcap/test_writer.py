"""What the writer puts into a file, and what becomes of it when the process does not end well."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from mcap.reader import make_reader

from chsel.errors import RecordingError
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from replay.events import (
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
)
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def run_script(script: str, path: Path, hash_seed: str = "0") -> subprocess.CompletedProcess[str]:
    """Run a script that finds the example's functions in `example` and a path in `path`."""
    head = f"import runpy; example = runpy.run_path({str(CONFTEST)!r}); path = {str(path)!r}\n"
    return subprocess.run(
        [sys.executable, "-c", head + script],
        env={**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def messages(path: Path, topic: str) -> list:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [message for _, _, message in reader.iter_messages([topic])]


def test_equal_sessions_give_equal_bytes_in_processes_with_other_hash_seeds(tmp_path):
    script = """
from replay.mcap.writer import McapRecorder
recorder = McapRecorder(path)
for event in example["example_events"]():
    recorder.record(event)
    if type(event).__name__ == "Measured":
        recorder.flush()
recorder.close()
"""
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path, seed in zip(paths, ("1", "2"), strict=True):
        result = run_script(script, path, seed)
        assert result.returncode == 0, result.stderr
    assert len(paths[0].read_bytes()) > 10_000
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_log_time_counts_messages_within_steps(events, write):
    with write(events).open("rb") as file:
        all_messages = [m for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    times = [message.log_time for message in all_messages]
    assert times == sorted(set(times))
    assert [time % 10**9 for time in times] == list(range(len(times)))
    assert {time // 10**9 for time in times} == {0, 1, 2, 3}
    assert all(message.publish_time == message.log_time for message in all_messages)


def test_all_that_was_flushed_survives_sigkill(tmp_path, events, assert_same):
    path = tmp_path / "killed.mcap"
    script = """
import os, signal
from replay.mcap.writer import McapRecorder
recorder = McapRecorder(path)
for event in example["example_events"]():
    recorder.record(event)
    if type(event).__name__ == "Measured":
        recorder.flush()
        if event.step == 2:
            break
recorder.record(event)
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert run_script(script, path).returncode == -signal.SIGKILL
    with pytest.raises(RecordingError, match="unfinished"):
        read_recording(path)
    recording = read_recording(path, partial=True)
    assert recording.damage == "unfinished"
    last = max(i for i, e in enumerate(events) if isinstance(e, Measured))
    assert_same(recording.events(), events[: last + 1])


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


def test_a_session_starts_once_and_first(tmp_path, events):
    recorder = McapRecorder(tmp_path / "recording.mcap")
    with pytest.raises(RecordingError, match="as first event"):
        recorder.record(events[1])
    recorder.record(events[0])
    with pytest.raises(RecordingError, match="needs one SessionStarted"):
        recorder.record(events[0])


def test_a_problem_with_points_of_its_own_is_refused(tmp_path, events):
    recorder = McapRecorder(tmp_path / "recording.mcap")
    posed = next(i for i, event in enumerate(events) if isinstance(event, ProblemPosed))
    for event in events[:posed]:
        recorder.record(event)
    problem = events[posed].problem
    extra = problem.points.merged(KnownPoints(free=[[0.0, 0.0, 0.0]]))
    with pytest.raises(RecordingError, match="problem of step 1 has points"):
        recorder.record(ProblemPosed(1, dataclasses.replace(problem, points=extra)))


def test_arrays_of_another_type_or_shape_are_refused(tmp_path, events):
    posed = next(i for i, event in enumerate(events) if isinstance(event, ProblemPosed))
    found = next(e.hypotheses for e in events if isinstance(e, HypothesesFound))
    narrow = dataclasses.replace(found, cell=found.cell.astype(np.int32))
    longer = dataclasses.replace(found, duplicate=np.zeros(6, dtype=bool))
    short = dataclasses.replace(found, cost=found.cost[:4])
    for number, (wrong, message) in enumerate(
        [
            (narrow, r"Hypotheses\.cell .* int32 \(5,\); .*int64 \(5\)"),
            (longer, r"Hypotheses\.duplicate .*bool \(6,\); .*bool \(5\)"),
            (short, "Hypotheses of step 1: it has a value of another shape or type"),
        ]
    ):
        recorder = McapRecorder(tmp_path / f"{number}.mcap")
        for event in events[: posed + 1]:
            recorder.record(event)
        with pytest.raises(RecordingError, match=message):
            recorder.record(HypothesesFound(1, wrong))


def test_what_repeats_is_stored_once(make_events, write, assert_same):
    events = make_events(elites=200, snapshots=1)
    path = write(events)
    stored = [len(message.data) for message in messages(path, "/hypotheses")]
    assert max(stored) < 200 * 16 * 8 + 3_000  # the elites, without the archive
    problems = [len(message.data) for message in messages(path, "/problem")]
    assert max(problems) < 200 * 16 * 8  # the low-cost set is that of the elites before it
    assert_same(read_recording(path).events(), events)


def test_an_archive_unlike_the_last_snapshot_is_stored(events, write, assert_same):
    changed = []
    for event in events:
        if isinstance(event, HypothesesFound):
            archive = dataclasses.replace(event.hypotheses.archive, refinement=2)
            found = dataclasses.replace(event.hypotheses, archive=archive)
            event = HypothesesFound(event.step, found)
        changed.append(event)
    assert_same(read_recording(write(changed)).events(), changed)


def test_viewers_get_points_and_poses(events, write):
    path = write(events)
    probe = next(e for e in events if isinstance(e, Probe) and e.step == 2)
    cloud = PointCloud.FromString(messages(path, "/points/known")[-1].data)
    values = np.frombuffer(cloud.data).reshape(-1, 4)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "sdf"]
    assert cloud.frame_id == "world"
    assert values[:, :3].tobytes() == probe.new_points.known.tobytes()
    assert values[:, 3].tobytes() == probe.new_points.sdf.tobytes()

    found = [e.hypotheses for e in events if isinstance(e, HypothesesFound)][-1]
    poses = PosesInFrame.FromString(messages(path, "/hypothesis_poses")[-1].data).poses
    expected = inverse(found.object_from_world)[:, :3, 3]
    positions = [[pose.position.x, pose.position.y, pose.position.z] for pose in poses]
    assert positions == expected.tolist()

    truth = FrameTransform.FromString(messages(path, "/object_pose")[0].data)
    assert (truth.parent_frame_id, truth.child_frame_id) == ("world", "object")
    assert truth.translation.y == events[0].world_from_object[1, 3]


@pytest.mark.parametrize("removed", ["file", "folder"])
def test_a_removed_recording_is_told_at_the_next_flush(tmp_path, events, removed):
    folder = tmp_path / "run"
    folder.mkdir()
    recorder = McapRecorder(folder / "recording.mcap")
    recorder.record(events[0])
    recorder.flush()
    if removed == "folder":
        shutil.rmtree(folder)
    else:
        (folder / "recording.mcap").unlink()
    recorder.record(events[1])
    with pytest.raises(RecordingError, match=r"recording\.mcap was removed while it was written"):
        recorder.flush()
    with pytest.raises(RecordingError, match="is closed"):
        recorder.record(events[2])
