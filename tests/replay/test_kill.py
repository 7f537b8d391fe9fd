"""A session that is killed leaves every probe that it reported as done."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from replay.__main__ import main
from replay.mcap.reader import read_recording
from tests.tools.kill_sessions import PROBES, points_session, reported_probes

pytestmark = pytest.mark.slow
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"}
SEEDS = (1, 2)  # one for each of two processes
KILLS = 30  # in each; thousands by hand, see kill_sessions


def test_every_reported_probe_survives_kills_at_random_moments() -> None:
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
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    overrides = points_session(tmp_path_factory.mktemp("points"))
    return (*overrides, "method=chsel", "method.descent.restarts=2", "method.descent.iterations=20")


@pytest.mark.parametrize("probes", [1, 3, 5])
def test_a_killed_command_leaves_both_files_readable(
    session: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    probes: int,
) -> None:
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
