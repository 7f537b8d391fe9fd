"""Sweeps of an evaluation through Hydra's launchers, as far as one machine can."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as parquet
import pytest
import yaml

from replay.mcap.reader import read_recording
from replay.registration import recorded_method

PLUGINS = {
    "joblib": "hydra_joblib_launcher",
    "submitit_local": "hydra_submitit_launcher",
    "submitit_slurm": "hydra_submitit_launcher",
    "ray": "hydra_ray_launcher",
}
SMALL = ("experiment=smoke", "configurations=mustard", "methods=[icp]", "steps=4", "workers=1")
# What submitit asks of SLURM, by a cluster of one machine that starts every job at once.
CLUSTER = {
    "sbatch": """#!/usr/bin/env bash
set -eu
file=${*: -1}
export SLURM_JOB_NUM_NODES=1 SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0
export SLURM_ARRAY_JOB_ID=7 SLURM_JOB_NODELIST=here
last=$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\).*/\\1/p' "$file")
for task in $(seq 0 "$last"); do
    SLURM_JOB_ID=7_$task SLURM_ARRAY_TASK_ID=$task setsid bash "$file" >/dev/null 2>&1 &
done
echo "Submitted batch job 7"
""",
    "srun": """#!/usr/bin/env bash
while [[ $1 == -* ]]; do
    if [[ $1 == --output || $1 == --error ]]; then shift; fi
    shift
done
exec "$@"
""",
    "sacct": """#!/usr/bin/env bash
printf 'JobID|State|NodeList\\n7_0|RUNNING|here\\n7_1|RUNNING|here\\n'
""",
}


def needs(launcher: str) -> None:
    plugin = PLUGINS[launcher]
    try:
        found = importlib.util.find_spec(f"hydra_plugins.{plugin}")
    except ModuleNotFoundError:
        found = None
    if found is None:
        extra = launcher.partition("_")[0]
        pytest.skip(f"needs {plugin}: pip install '.[sweep-{extra}]', see docs/sweeps.md")


def sweep(launcher: str, folder: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    """Run a sweep over seeds 0 and 1."""
    binaries = folder / "bin"
    binaries.mkdir()
    for name, text in CLUSTER.items():
        (binaries / name).write_text(text)
        (binaries / name).chmod(0o755)
    command = [sys.executable, "-m", "runners.evaluate", "-m", f"hydra/launcher={launcher}"]
    environment = {
        **os.environ,
        "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
    }
    return subprocess.run(
        [*command, "seeds=0,1", *SMALL, f"out={folder / 'evaluation'}", *overrides],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )


@pytest.mark.parametrize("launcher", PLUGINS)
def test_a_sweep_fills_one_table(launcher: str, tmp_path: Path) -> None:
    needs(launcher)
    done = sweep(launcher, tmp_path)
    assert done.returncode == 0, done.stderr
    evaluation = tmp_path / "evaluation"
    (sweep_folder,) = (evaluation / "sweeps").iterdir()
    told = yaml.safe_load((sweep_folder / "multirun.yaml").read_text())
    assert PLUGINS[launcher] in told["hydra"]["launcher"]["_target_"]
    rows = parquet.read_table(evaluation / "results.parquet").to_pylist()
    assert [(row["seed"], row["step"], row["status"]) for row in rows] == [
        (0, 4, "ok"),
        (1, 4, "ok"),
    ]
    for row in rows:
        recording = read_recording(evaluation / f"trials/mustard/seed_{row['seed']}/icp.mcap")
        here = recorded_method(recording).method.register(recording.problem(4))
        assert here.digest == row["digest"]


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_a_mistake_in_a_job_is_told_by_the_sweep(launcher: str, tmp_path: Path) -> None:
    needs(launcher)
    done = sweep(launcher, tmp_path, "metrics.points=0")
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: evaluate.metrics: points is 0; accepted")
    assert "Traceback" not in done.stderr
