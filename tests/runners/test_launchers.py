"""Sweeps of runners.probe through Hydra's launchers, as far as one machine can."""

import importlib.util
import os
import re
import subprocess
import sys

import pytest
import yaml

from replay.comparing.choices import recorded_method
from replay.mcap.reader import read_recording

pytestmark = pytest.mark.slow
PLUGINS = {"joblib": "hydra_joblib_launcher", "submitit_local": "hydra_submitit_launcher"}
SMALL = ("object=mustard", "session=kinematic", "method=icp", "recording=mcap")


def needs(launcher):
    plugin = PLUGINS[launcher]
    try:
        found = importlib.util.find_spec(f"hydra_plugins.{plugin}")
    except ModuleNotFoundError:
        found = None
    if found is None:
        extra = launcher.partition("_")[0]
        pytest.skip(f"needs {plugin}: pip install -e '.[sweep-{extra}]', see docs/sweeps.md")


def sweep(launcher, folder, *overrides):
    """Run a sweep over seeds 0 and 1."""
    command = [sys.executable, "-m", "runners.probe", "-m", f"hydra/launcher={launcher}"]
    command += ["seed=0,1", *SMALL, f"logs={folder / 'logs'}", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)


@pytest.mark.parametrize("launcher", PLUGINS)
def test_every_job_of_a_sweep_records_its_session(launcher, tmp_path):
    needs(launcher)
    done = sweep(launcher, tmp_path)
    assert done.returncode == 0, done.stderr
    (settings,) = tmp_path.rglob("multirun.yaml")
    chosen = yaml.safe_load(settings.read_text())
    assert PLUGINS[launcher] in chosen["hydra"]["launcher"]["_target_"]
    recordings = [read_recording(path) for path in tmp_path.rglob("recording.mcap")]
    assert sorted(recording.start.seed for recording in recordings) == [0, 1]
    for recording in recordings:
        here = recorded_method(recording).build().register(recording.problem(4))
        assert here.digest == recording.hypotheses(4).digest


@pytest.mark.parametrize("launcher", PLUGINS)
def test_a_mistake_in_a_job_is_an_error_of_the_sweep(launcher, tmp_path):
    needs(launcher)
    done = sweep(launcher, tmp_path, "method.iterations=-1")
    assert done.returncode == 2, done.stderr
    assert re.match(r"error: .*iterations is -1; accepted", done.stderr.splitlines()[-1])
    assert "Traceback" not in done.stderr
