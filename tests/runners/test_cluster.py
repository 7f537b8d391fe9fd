"""Evaluations and sweeps on clusters: other folders, SLURM, keys and lost schedulers."""

import asyncio
import importlib.util
import json
import os
import ssl
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pyarrow.parquet
import pytest
import yaml
from distributed.comm import connect

from chsel.errors import SettingError
from replay.comparing.choices import recorded_method
from replay.mcap.reader import read_recording
from runners.evaluation.tasks import connected
from tests.runners.test_evaluate import METHODS, evaluated

pytestmark = pytest.mark.slow
REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The table of an evaluation by workers of this machine."""
    folder = tmp_path_factory.mktemp("here")
    assert evaluated(folder, METHODS).returncode == 0
    return results(folder)


@pytest.fixture
def scheduler(tmp_path):
    """The address of a scheduler with two workers, each in a folder of its own."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    file = tmp_path / "scheduler.json"
    where = ["--scheduler-file", str(file)]
    with ExitStack() as stack:

        def start(name, *arguments):
            (tmp_path / name).mkdir()
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{arguments[0]}", *arguments[1:]],
                cwd=tmp_path / name,
                env=environment,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        scheduler = start(
            "s", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *where
        )
        for name in ("a", "b"):
            start(name, "worker", "--nthreads", "1", "--local-directory", ".", *where)
        while not file.exists():
            assert scheduler.poll() is None
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"]


def results(folder):
    """The rows but for the time that they took."""
    rows = pyarrow.parquet.read_table(folder / "results.parquet").to_pylist()
    return [{**row, "seconds": None} for row in rows]


def test_workers_in_other_folders_give_the_same_table(here, scheduler, tmp_path):
    done = evaluated(tmp_path / "out", METHODS, "workers=null", f"scheduler={scheduler}")
    assert (done.returncode, done.stderr) == (0, "")
    assert results(tmp_path / "out") == here


SBATCH = """#!/usr/bin/env bash
cp "${*: -1}" "$(dirname "$0")/job"
setsid bash "$(dirname "$0")/job" >/dev/null 2>&1 &
echo "Submitted batch job $!"
"""
SCANCEL = """#!/usr/bin/env bash
kill -- "-$1"
"""


def test_jobs_of_slurm_give_the_same_table(here, tmp_path, monkeypatch):
    """SLURM is two scripts here, of which the first starts the job on this machine."""
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("DASK_JOBQUEUE__SLURM__INTERFACE", "lo")
    done = evaluated(tmp_path / "out", METHODS, "workers=1", "scheduler=slurm")
    assert (done.returncode, done.stderr) == (0, "")
    assert results(tmp_path / "out") == here


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "ftp://a:1"])
def test_a_scheduler_that_is_not_there_is_one_line_at_once(address, monkeypatch):
    """Without a client of Dask, which waits for a minute when it is given up."""
    monkeypatch.setattr("distributed.Client", lambda *_, **__: pytest.fail("it has a client"))
    with (
        pytest.raises(SettingError, match=r"scheduler is .*; accepted: the address of"),
        connected(address, None),
    ):
        pass


def test_nobody_without_the_keys_of_a_run_can_connect():
    trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # has no key, and asks for none
    trusting.check_hostname = False
    trusting.verify_mode = ssl.CERT_NONE
    with connected(None, 1) as (client, _):
        for address in (client.cluster.scheduler_address, *client.nthreads()):
            plain = address.replace("tls://", "tcp://")
            for where, keys in ((plain, {}), (address, {"ssl_context": trusting})):
                with pytest.raises(OSError, match=where):
                    asyncio.run(connect(where, timeout=1, **keys))


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
    return subprocess.run(command, capture_output=True, text=True, env=environment)


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
