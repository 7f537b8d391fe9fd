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
from functools import partial
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


def time_of_torch() -> float:
    """Seconds of a process that only imports torch."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import torch"], check=True)
    return time.perf_counter() - begun


def first_and_later_start(
    problem: Path, preset: str, steps: Steps, repeats: int
) -> tuple[float, dict[str, tuple[float, ...]]]:
    """Seconds of processes that register once: with no compiled kernel on disk, and with all.

    The latter in turn without torch, which no registration needs, and with torch imported, too.
    """
    from runners.benchmarks.timing import in_turn  # it imports torch, which a fresh process lacks

    task = _task(problem, preset, steps)
    with tempfile.TemporaryDirectory() as folder:
        first = _run(task, cache=folder)[0]
        later = {
            name: partial(lambda task: _run(task, cache=folder)[0], {**task, "torch": torch})
            for name, torch in (("later", False), ("later, with torch", True))
        }
        return first, in_turn(repeats, later)


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
