"""Measurements that need a process of their own: memory, and the time to start."""

from __future__ import annotations

import base64
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from runners.benchmarks.registrations import Steps, method

_CACHE = "CHSEL_CACHE_DIR"


def memory_of_one(problem: Path, preset: str | None, steps: Steps) -> int:
    """Peak bytes of a process that registers a saved problem, or only imports the library."""
    return int(_run(_task(problem, preset, steps))[1]["bytes"])


def time_of_imports() -> float:
    """Seconds of a process that only imports the library."""
    return _run({})[0]


def first_and_later_start(
    problem: Path, preset: str, steps: Steps, repeats: int
) -> tuple[float, tuple[float, ...]]:
    """Seconds of processes that register once: with no compiled kernel on disk, and with all."""
    task = _task(problem, preset, steps)
    with tempfile.TemporaryDirectory() as folder:
        first = _run(task, cache=folder)[0]
        return first, tuple(_run(task, cache=folder)[0] for _ in range(repeats))


def _task(problem: Path, preset: str | None, steps: Steps) -> dict[str, Any]:
    if preset is None:
        return {}
    made = pickle.dumps(method(preset, steps, steps.search))
    return {"problem": str(problem), "method": base64.b64encode(made).decode()}


def _run(task: dict[str, Any], cache: str | None = None) -> tuple[float, dict[str, Any]]:
    """Seconds that the process took, and its answer."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if cache is not None:
        environment[_CACHE] = cache
    command = [sys.executable, "-m", "runners.benchmarks.fresh_process", json.dumps(task)]
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    seconds = time.perf_counter() - begun
    answer: dict[str, Any] = json.loads(done.stdout)
    return seconds, answer
