"""Measurements that need a process of their own: memory, and the time to start.

As a program: `python -m runners.benchmarks.fresh JSON` imports the library, registers once if JSON
names a preset, and prints its peak memory. It imports torch first if JSON says so.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from runners.benchmarks.registrations import Steps, method
from runners.published_package.problem_file import load_problem

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
    return {"problem": str(problem), "preset": preset, "steps": dataclasses.asdict(steps)}


def _run(task: dict[str, Any], cache: str | None = None) -> tuple[float, dict[str, Any]]:
    """Seconds that the process took, and its answer."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if cache is not None:
        environment[_CACHE] = cache
    command = [sys.executable, "-m", "runners.benchmarks.fresh", json.dumps(task)]
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    seconds = time.perf_counter() - begun
    answer: dict[str, Any] = json.loads(done.stdout)
    return seconds, answer


def main(task: dict[str, Any]) -> None:
    """Do the task of one such process."""
    if task.get("torch"):
        import torch  # noqa: F401
    if task:
        steps = Steps(**task["steps"])
        problem = load_problem(Path(task["problem"]))
        method(task["preset"], steps, steps.search).register(problem)
    sys.stdout.write(json.dumps({"bytes": peak_memory()}) + "\n")


def peak_memory() -> int:
    """Peak memory of this process in bytes."""
    # Not getrusage where there is another way: a new process inherits its parent's peak there.
    try:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
