"""Runs that a full disk, a kill or a closed pipe ends: the recording so far is intact."""

import json
import os
import resource
import subprocess
import sys

import pytest

from replay.__main__ import main as replay_main
from replay.mcap.reader import read_recording
from tests.runners.box_session import points_session, reported_probes

pytestmark = pytest.mark.slow
PROBES = 6


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """The overrides of a session whose archives grow to megabytes."""
    overrides = points_session(tmp_path_factory.mktemp("points"))
    quick = ("method=chsel", "method.descent.restarts=2", "method.descent.iterations=20")
    return (*overrides, *quick, "method.archive.bins=400", "method.emitter.iterations=200")


def start(logs, *overrides, limit=None):
    """The command, with a limit on the size of files in bytes."""

    def set_limit():
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [sys.executable, "-u", "-m", "runners.probe", *overrides, f"logs={logs}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "COLUMNS": "120", "OMP_NUM_THREADS": "1"},
        preexec_fn=set_limit,
    )


def run_folder(logs):
    (folder,) = (logs / "probe").iterdir()
    return folder


def recovered(path):
    out = path.with_name("recovered.mcap")
    assert replay_main(["recover", str(path), "-o", str(out)]) == 0
    return read_recording(out)


def test_a_full_disk_is_one_error_and_every_reported_probe_stays(session, tmp_path):
    process = start(tmp_path, *session, "recording=both", limit=1_200_000)
    output, errors = process.communicate()
    assert process.returncode == 2
    folder = run_folder(tmp_path)
    reason = f"recording {folder / 'recording.mcap'} cannot be written: File too large"
    assert errors.splitlines()[-1] == f"error: {reason}"
    assert errors.count("error: ") == 1
    recording = recovered(folder / "recording.mcap")
    assert 1 <= reported_probes(output) < PROBES
    assert set(range(reported_probes(output))) <= set(recording.steps)
    assert json.loads((folder / "summary.json").read_text())["outcome"] == f"failed: {reason}"


def test_every_reported_probe_of_a_killed_run_is_recovered(session, tmp_path):
    process = start(tmp_path, *session, "recording=mcap")
    output = ""
    for line in process.stdout:
        output += line
        if reported_probes(output) == 2:
            break
    process.kill()
    output += process.communicate()[0]
    assert reported_probes(output) >= 2
    recording = recovered(run_folder(tmp_path) / "recording.mcap")
    assert set(range(reported_probes(output))) <= set(recording.steps)


def test_output_that_nobody_reads_ends_the_run_with_a_whole_recording(session, tmp_path):
    """As with `| head`: no error is printed, and the status is that of a broken pipe."""
    process = start(tmp_path, *session[:-1], "method.emitter.iterations=2000", "recording=both")
    while not process.stdout.readline().startswith("probe "):
        assert process.poll() is None
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 1
    recording = read_recording(run_folder(tmp_path) / "recording.mcap")
    assert recording.ended.outcome == "interrupted"
    assert len(recording.steps) >= 1
    summary = json.loads((run_folder(tmp_path) / "summary.json").read_text())
    assert summary["outcome"] == "interrupted"
